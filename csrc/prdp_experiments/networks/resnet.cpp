#include "prdp_experiments/networks/resnet.h"

#include <torch/nn/modules/activation.h>
#include <torch/nn/modules/container/sequential.h>
#include <torch/nn/modules/conv.h>

namespace prdp {

namespace {

using torch::nn::AnyModule;

/// Keeps the extents of its input; `kernel` is odd.
template <class Conv, size_t D>
AnyModule convolution(int64_t from, int64_t to, int64_t kernel, bool periodic) {
  torch::nn::ConvOptions<D> options(from, to, kernel);
  options.padding(kernel / 2);
  if (periodic) options.padding_mode(torch::kCircular);
  return AnyModule(Conv(options));
}

AnyModule convolution(int64_t dim, int64_t from, int64_t to, int64_t kernel, bool periodic = false) {
  TORCH_CHECK_VALUE(dim >= 1 && dim <= 3, "ResNet: dim must be 1, 2 or 3, got ", dim);
  if (dim == 1) return convolution<torch::nn::Conv1d, 1>(from, to, kernel, periodic);
  if (dim == 2) return convolution<torch::nn::Conv2d, 2>(from, to, kernel, periodic);
  return convolution<torch::nn::Conv3d, 3>(from, to, kernel, periodic);
}

}  // namespace

ResNetImpl::ResNetImpl(int64_t dim, int64_t channels, int64_t blocks, int64_t width, bool periodic)
    : lift_(convolution(dim, channels, width, 1)) {
  for (int64_t i = 0; i < blocks; ++i) {
    torch::nn::Sequential block;
    block->push_back(convolution(dim, width, width, 3, periodic));
    block->push_back(torch::nn::ReLU());
    block->push_back(convolution(dim, width, width, 3, periodic));
    blocks_->push_back(block);
  }
  project_ = convolution(dim, width, channels, 1);
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
