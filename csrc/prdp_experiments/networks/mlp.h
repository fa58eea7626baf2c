#pragma once
#include <torch/nn/module.h>
#include <torch/nn/modules/container/modulelist.h>
#include <torch/nn/pimpl.h>

#include <vector>

namespace prdp {

/// A multilayer perceptron with ReLU between its layers. It maps a field (batch, channels, *shape) to one of the same
/// shape. Its parameters are layers.0.weight, layers.0.bias, …, with torch's default initialisation.
/// prdp_torch.experiments.networks.MLP is the same network in Python: same names, order and weights for the same seed.
class MLPImpl : public torch::nn::Module {
 public:
  /// Widths of the layers: unknowns → hidden[0] → … → unknowns. `unknowns` is channels times the number of points.
  MLPImpl(int64_t unknowns, const std::vector<int64_t>& hidden);
  torch::Tensor forward(const torch::Tensor& u);

 private:
  torch::nn::ModuleList layers_;
};
TORCH_MODULE(MLP);

}  // namespace prdp
