#include "prdp_experiments/networks/mlp.h"

#include <torch/nn/modules/linear.h>

namespace prdp {

MLPImpl::MLPImpl(int64_t unknowns, const std::vector<int64_t>& hidden) {
  int64_t width = unknowns;
  for (const int64_t next : hidden) {
    layers_->push_back(torch::nn::Linear(width, next));
    width = next;
  }
  layers_->push_back(torch::nn::Linear(width, unknowns));
  register_module("layers", layers_);
}

torch::Tensor MLPImpl::forward(const torch::Tensor& u) {
  auto x = u.flatten(1);
  for (size_t i = 0; i < layers_->size(); ++i) {
    if (i > 0) x = x.relu();
    x = layers_->ptr<torch::nn::LinearImpl>(i)->forward(x);
  }
  return x.view(u.sizes());
}

}  // namespace prdp
