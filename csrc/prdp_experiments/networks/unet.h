#pragma once
#include <torch/nn/modules/container/any.h>
#include <torch/nn/modules/container/modulelist.h>
#include <torch/nn/pimpl.h>

namespace prdp {

/// A U-net without normalisation (Ronneberger et al. 2015). It maps a field (batch, channels, *shape) to one of the
/// same shape. A block is two convolutions with kernels of width three, a ReLU after each. On the way down there is a
/// block on each of `levels` + 1 grids, each half as fine as the one before by means of 2^dim cells, with width, 2
/// width, 4 width, … channels. On the way up, each value is repeated into 2^dim cells, the output of the block of this
/// grid on the way down is added as further channels, and a block follows. A pointwise convolution ends it. Beyond the
/// grid, the blocks see the other end of the field if `periodic`, else zeros. The parameters are down.0.0.weight,
/// down.0.0.bias, down.0.2.weight, …, up.0.0.weight, …, project.weight, project.bias, up.0 on the second-coarsest
/// grid, with torch's default initialisation. prdp_torch.experiments.networks.UNet is the same network in Python: same
/// names, order and weights for the same seed.
class UNetImpl : public torch::nn::Module {
 public:
  /// `dim` is the number of axes in `shape`. Raises ValueError unless it is 1, 2 or 3.
  UNetImpl(int64_t dim, int64_t channels, int64_t levels, int64_t width, bool periodic);
  /// Raises ValueError unless 2^levels divides each extent.
  torch::Tensor forward(const torch::Tensor& u);

 private:
  int64_t dim_, levels_;
  torch::nn::ModuleList down_, up_;
  torch::nn::AnyModule project_;
};
TORCH_MODULE(UNet);

}  // namespace prdp
