#include "prdp_experiments/networks/resnet.h"

#include <torch/nn/modules/activation.h>
#include <torch/nn/modules/container/sequential.h>

#include "prdp_experiments/networks/convolution.h"

namespace prdp {

ResNetImpl::ResNetImpl(int64_t dim, int64_t channels, int64_t blocks, int64_t width, bool periodic)
    : lift_(convolution("ResNet", dim, channels, width, 1)) {
  for (int64_t i = 0; i < blocks; ++i) {
    torch::nn::Sequential block;
    block->push_back(convolution("ResNet", dim, width, width, 3, periodic));
    block->push_back(torch::nn::ReLU());
    block->push_back(convolution("ResNet", dim, width, width, 3, periodic));
    blocks_->push_back(block);
  }
  project_ = convolution("ResNet", dim, width, channels, 1);
  register_module("lift", lift_.ptr());
  register_module("blocks", blocks_);
  register_module("project", project_.ptr());
}

torch::Tensor ResNetImpl::forward(const torch::Tensor& u) {
  auto x = lift_.forward(u);
  for (size_t i = 0; i < blocks_->size(); ++i) x = (x + blocks_->ptr<torch::nn::SequentialImpl>(i)->forward(x)).relu();
  return project_.forward(x);
}

}  // namespace prdp
