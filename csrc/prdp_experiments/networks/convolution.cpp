#include "prdp_experiments/networks/convolution.h"

#include <torch/nn/modules/conv.h>

namespace prdp {

namespace {

using torch::nn::AnyModule;

template <class Conv, size_t D>
AnyModule made(int64_t from, int64_t to, int64_t kernel, bool periodic) {
  torch::nn::ConvOptions<D> options(from, to, kernel);
  options.padding(kernel / 2);
  if (periodic) options.padding_mode(torch::kCircular);
  return AnyModule(Conv(options));
}

}  // namespace

AnyModule convolution(const char* who, int64_t dim, int64_t from, int64_t to, int64_t kernel, bool periodic) {
  TORCH_CHECK_VALUE(dim >= 1 && dim <= 3, who, ": dim must be 1, 2 or 3, got ", dim);
  if (dim == 1) return made<torch::nn::Conv1d, 1>(from, to, kernel, periodic);
  if (dim == 2) return made<torch::nn::Conv2d, 2>(from, to, kernel, periodic);
  return made<torch::nn::Conv3d, 3>(from, to, kernel, periodic);
}

}  // namespace prdp
