#pragma once
#include <torch/nn/modules/container/any.h>

namespace prdp {

/// A convolution over `dim` axes that keeps the extents of its input; `kernel` is odd. Beyond the grid it sees the
/// other end of the field if `periodic`, else zeros. Raises ValueError in the name of `who` unless dim is 1, 2 or 3.
torch::nn::AnyModule convolution(const char* who, int64_t dim, int64_t from, int64_t to, int64_t kernel,
                                 bool periodic = false);

}  // namespace prdp
