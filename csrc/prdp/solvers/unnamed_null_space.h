#pragma once
#include "prdp/solvers/solve.h"

namespace prdp {

/// How large each row of A, or of Aᵀ, is, as products with two vectors of no structure tell it: like b, in double.
at::Tensor row_sizes(const Operator& a, const at::Tensor& b, bool transposed);

/// Whether A, or Aᵀ if `transposed`, maps the constant of each channel to zero, or only that of all channels `jointly`,
/// each row up to its own rounding: bool, (batch,).
at::Tensor maps_constant_to_zero(const Operator& a, const at::Tensor& b, bool transposed, bool jointly = false);

/// Marks an unsolved sample INCONSISTENT if Aᵀ maps the constant to zero, no null space was named, and b has a constant
/// part above rounding. Its u is of no use: what rounding adds along the null space of A grows from iteration to
/// iteration. The products that tell it are spent where a solve took hundreds, or where u looks like that.
void mark_inconsistent_constants(const Operator& a, const at::Tensor& b, const SolveRequest& request,
                                 SolveResult& result);

}  // namespace prdp
