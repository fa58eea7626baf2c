#pragma once
#include <ATen/ATen.h>

namespace prdp {

/// Tridiagonal systems, closed to a ring or not, as tensor operations: what kernels/cyclic_thomas.h does row by row, in
/// log2 n steps of parallel cyclic reduction. That eliminates in another order, without pivoting as well, so it is
/// stable for the same matrices: those that are diagonally dominant by rows or by columns.
class CyclicReduction {
 public:
  /// `coefficients`: (batch or 1, 3, n), the diagonal and what couples a point to those before and behind it;
  /// zero where there is none. `slack`: what rounding may hide of the dominance.
  CyclicReduction(const at::Tensor& coefficients, double slack);

  /// Which matrices are dominant, or not finite: (batch or 1,).
  at::Tensor is_dominant() const;
  /// A⁻¹ b for b (batch, channels, n) in their dtype; NaN where A is singular: where its last pivot, the only one that
  /// a dominant matrix may lose, is rounding.
  at::Tensor solve(const at::Tensor& b) const;
  /// The same where A and Aᵀ map the constant to zero: a solution of mean zero, for b of mean zero.
  at::Tensor solve_with_constant(const at::Tensor& b) const;

 private:
  /// M⁻¹ b for all unknowns but the last one, b being (…, n), with M⁻¹e as one more row in front.
  at::Tensor reduce(const at::Tensor& b) const;
  /// The rows of b, as those of one system where all samples share it.
  at::Tensor rows_of(const at::Tensor& b) const;

  double slack_;
  int64_t n_;
  at::Tensor coefficients_;
  // [[M, e], [f, c]], and what M has beside its diagonal.
  at::Tensor pivot_, lower_, upper_, column_, border_, corner_;
};

}  // namespace prdp
