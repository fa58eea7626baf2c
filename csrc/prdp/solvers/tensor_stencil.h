#pragma once
#include <ATen/ATen.h>

#include <array>
#include <functional>
#include <vector>

namespace prdp {

/// An operator that couples points at most one cell apart, as tensors: what multigrid makes coarse grids of on devices
/// without loops of their own (tensor_cycles.h). The same for every channel of a vector (batch, channel, *shape).
struct TensorStencil {
  struct Entry {
    std::vector<int64_t> offset;  // -1, 0 or 1 for each axis
    at::Tensor coefficient;       // (batch or 1, *shape)
  };
  std::vector<int64_t> shape;
  std::vector<bool> periodic;
  std::vector<Entry> entries;  // the centre first

  int64_t dim() const { return static_cast<int64_t>(shape.size()); }
  at::Tensor apply(const at::Tensor& v) const;
  /// b - A v
  at::Tensor residual(const at::Tensor& b, const at::Tensor& v) const;
  TensorStencil transposed() const;
  const at::Tensor& diagonal() const { return entries[0].coefficient; }
  /// All coefficients, (entry, batch or 1, *shape).
  at::Tensor coefficients() const;
};

/// At i, what t (…, *shape) holds at i + offset; zeros beyond the ends of an axis that is not periodic.
at::Tensor neighbours(const at::Tensor& t, const TensorStencil& like, const std::vector<int64_t>& offset);

/// The stencil that a product consists of, by products with vectors that are one on every third point. `product`
/// takes (batch, 1, *shape) with the batch of the operator to the same. An axis is periodic if its ends couple.
TensorStencil probe(const std::function<at::Tensor(const at::Tensor&)>& product, int64_t batch,
                    const std::vector<int64_t>& shape, const at::TensorOptions& options);

}  // namespace prdp
