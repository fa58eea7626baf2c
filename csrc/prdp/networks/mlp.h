#pragma once
#include <torch/nn/module.h>
#include <torch/nn/modules/container/modulelist.h>
#include <torch/nn/pimpl.h>

#include <vector>

namespace prdp {

/// Multilayer perceptron with ReLU between its layers, from a field to a field of the same shape
/// (batch, channels, *shape). Parameters layers.0.weight, layers.0.bias, …; torch's default initialisation.
/// prdp_torch.experiments.networks.MLP is its twin: same names, same order, same weights from the same seed.
class MLPImpl : public torch::nn::Module {
 public:
  /// unknowns → hidden[0] → … → unknowns
  MLPImpl(int64_t unknowns, const std::vector<int64_t>& hidden);
  torch::Tensor forward(const torch::Tensor& u);

 private:
  torch::nn::ModuleList layers_;
};
TORCH_MODULE(MLP);

}  // namespace prdp
