#include "prdp_experiments/networks/unet.h"

#include <torch/nn/functional/pooling.h>
#include <torch/nn/functional/upsampling.h>
#include <torch/nn/modules/activation.h>
#include <torch/nn/modules/container/sequential.h>

#include "prdp_experiments/networks/convolution.h"

namespace prdp {

namespace {

namespace F = torch::nn::functional;

torch::nn::Sequential make_block(int64_t dim, int64_t from, int64_t to, bool periodic) {
  torch::nn::Sequential block;
  for (const auto channels : {from, to}) {
    block->push_back(convolution("UNet", dim, channels, to, 3, periodic));
    block->push_back(torch::nn::ReLU());
  }
  return block;
}

torch::Tensor run(const torch::nn::ModuleList& blocks, int64_t i, const torch::Tensor& x) {
  return blocks->ptr<torch::nn::SequentialImpl>(i)->forward(x);
}

torch::Tensor halved(const torch::Tensor& x, int64_t dim) {
  if (dim == 1) return F::avg_pool1d(x, F::AvgPool1dFuncOptions(2));
  if (dim == 2) return F::avg_pool2d(x, F::AvgPool2dFuncOptions(2));
  return F::avg_pool3d(x, F::AvgPool3dFuncOptions(2));
}

torch::Tensor doubled(const torch::Tensor& x, int64_t dim) {
  return F::interpolate(x, F::InterpolateFuncOptions().scale_factor(std::vector<double>(dim, 2.0)));
}

}  // namespace

UNetImpl::UNetImpl(int64_t dim, int64_t channels, int64_t levels, int64_t width, bool periodic)
    : dim_(dim), levels_(levels) {
  const auto width_of = [&](int64_t level) { return width << level; };
  down_->push_back(make_block(dim, channels, width, periodic));
  for (int64_t l = 1; l <= levels; ++l) down_->push_back(make_block(dim, width_of(l - 1), width_of(l), periodic));
  for (int64_t l = levels - 1; l >= 0; --l)
    up_->push_back(make_block(dim, width_of(l + 1) + width_of(l), width_of(l), periodic));
  project_ = convolution("UNet", dim, width, channels, 1);
  register_module("down", down_);
  register_module("up", up_);
  register_module("project", project_.ptr());
}

torch::Tensor UNetImpl::forward(const torch::Tensor& u) {
  for (const auto n : u.sizes().slice(2))
    TORCH_CHECK_VALUE(n % (int64_t{1} << levels_) == 0, "UNet: expected extents that 2^", levels_, " divides, got ",
                      u.sizes().slice(2));
  std::vector<torch::Tensor> passed;
  auto x = run(down_, 0, u);
  for (int64_t l = 1; l <= levels_; ++l) {
    passed.push_back(x);
    x = run(down_, l, halved(x, dim_));
  }
  for (int64_t i = 0; i < levels_; ++i) {
    x = run(up_, i, torch::cat({doubled(x, dim_), passed.back()}, 1));
    passed.pop_back();
  }
  return project_.forward(x);
}

}  // namespace prdp
