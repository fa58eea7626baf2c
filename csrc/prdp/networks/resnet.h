#pragma once
#include <torch/nn/modules/container/any.h>
#include <torch/nn/modules/container/modulelist.h>
#include <torch/nn/pimpl.h>

namespace prdp {

/// Residual network (He et al. 2016, without normalisation) from a field (batch, channels, *shape) of
/// any extents to one of the same shape: a convolution lifts channels → width point by point, `blocks`
/// times x ← relu(x + conv(relu(conv(x)))) with three-wide kernels, and a last convolution projects
/// width → channels point by point. Beyond the grid the blocks see the other end of the field where it
/// is periodic, else zeros. Parameters lift.weight, lift.bias, blocks.0.0.weight, blocks.0.0.bias,
/// blocks.0.2.weight, …, project.weight, project.bias; torch's default initialisation.
/// prdp_torch.experiments.networks.ResNet is its twin: same names, same order, same weights from the same seed.
class ResNetImpl : public torch::nn::Module {
 public:
  /// `dim` axes in `shape`; raises ValueError unless 1, 2 or 3.
  ResNetImpl(int64_t dim, int64_t channels, int64_t blocks, int64_t width, bool periodic);
  torch::Tensor forward(const torch::Tensor& u);

 private:
  torch::nn::AnyModule lift_, project_;
  torch::nn::ModuleList blocks_;
};
TORCH_MODULE(ResNet);

}  // namespace prdp
