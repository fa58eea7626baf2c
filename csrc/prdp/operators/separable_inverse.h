#pragma once
#include <ATen/ATen.h>

#include "prdp/kernels/fast_diagonalisation.h"

namespace prdp {

/// float64, where a device has it.
inline at::ScalarType widest_real(const at::Device& device) {
  return device.type() == at::kMPS ? at::kFloat : at::kDouble;
}

/// v (batch, channel, *shape) with a matrix (n, n) along each axis of the grid, or with its transpose: one product with
/// small matrices an axis. v takes the dtype of the matrices: products in float32 would round to TF32 where a program
/// allows that.
at::Tensor along_axes(const at::Tensor& v, at::TensorList matrices, bool transposed);

/// The points of a grid without some planes at the ends of its axes: those from `first` on.
struct InnerBox {
  std::vector<int64_t> first, shape;
  /// t, whose last axes are those of the grid, there.
  at::Tensor of(at::Tensor t) const;
};

/// The inverse of a sum of operators along the axes, by their eigenvectors or by FFT, as tensor operations. On the CPU:
/// kernels/fast_diagonalisation.h.
class SeparableInverse {
 public:
  /// `a` is the sum on the inner points of the grid; A is diagonal on the others, as where a wall says the velocity.
  /// For vectors with the dtype and device of `options`.
  SeparableInverse(const kernels::DiagonalisedSum& a, InnerBox box, const at::TensorOptions& options);

  /// A⁻¹ b, or its pseudo-inverse where null vectors were named, for b (batch, channel, *shape) and the diagonal of A;
  /// NaN if A is singular.
  at::Tensor solve(const at::Tensor& b, const at::Tensor& diagonal) const;
  int64_t bytes() const;

 private:
  at::Tensor solve_inside(const at::Tensor& b) const;

  InnerBox box_;
  std::vector<at::Tensor> eigenvectors_;  // of each axis, in widest_real(); none: the waves of a periodic box
  at::Tensor inverse_;                    // of the eigenvalues; undefined: A is singular
};

}  // namespace prdp
