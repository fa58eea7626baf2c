#pragma once
#include <torch/nn/modules/container/any.h>
#include <torch/nn/modules/container/modulelist.h>
#include <torch/nn/pimpl.h>

namespace prdp {

/// A residual convolution network without normalisation (He et al. 2016). It maps a field (batch, channels, *shape) on
/// any grid to one of the same shape. A pointwise convolution lifts the channels to `width`. Each of the `blocks`
/// computes x ← relu(x + conv(relu(conv(x)))) with kernels of width three. A pointwise convolution projects back.
/// Beyond the grid, the blocks see the other end of the field if `periodic`, else zeros. The parameters are
/// lift.weight, lift.bias, blocks.0.0.weight, blocks.0.0.bias, blocks.0.2.weight, …, project.weight, project.bias, with
/// torch's default initialisation. prdp_torch.experiments.networks.ResNet is the same network in Python: same names,
/// order and weights for the same seed.
class ResNetImpl : public torch::nn::Module {
 public:
  /// `dim` is the number of axes in `shape`. Raises ValueError unless it is 1, 2 or 3.
  ResNetImpl(int64_t dim, int64_t channels, int64_t blocks, int64_t width, bool periodic);
  torch::Tensor forward(const torch::Tensor& u);

 private:
  torch::nn::AnyModule lift_, project_;
  torch::nn::ModuleList blocks_;
};
TORCH_MODULE(ResNet);

}  // namespace prdp
