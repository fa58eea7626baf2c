#pragma once
#include <ATen/ATen.h>

#include "prdp/kernels/fast_diagonalisation.h"

namespace prdp {

/// v (batch, channel, *shape) with a matrix (n, n) along each axis of the grid, or with its transpose: one product with
/// small matrices an axis. A float32 v is taken in double: its products would round to TF32 where a program allows
/// that.
at::Tensor along_axes(const at::Tensor& v, at::TensorList matrices, bool transposed);

/// The inverse of a sum of operators along the axes (kernels/fast_diagonalisation.h) as tensor operations.
class TensorAxes {
 public:
  /// For vectors with the dtype and device of `options`.
  TensorAxes(const kernels::DiagonalisedSum& a, at::IntArrayRef shape, const at::TensorOptions& options);

  /// A⁻¹ b, or its pseudo-inverse where null vectors were named, for b (batch, channel, *shape); NaN if A is singular.
  at::Tensor solve(const at::Tensor& b) const;
  int64_t bytes() const;

 private:
  std::vector<int64_t> shape_;
  std::vector<at::Tensor> eigenvectors_;  // of each axis, in double; none: the waves of a periodic box
  at::Tensor inverse_;                    // of the eigenvalues; undefined: A is singular
};

}  // namespace prdp
