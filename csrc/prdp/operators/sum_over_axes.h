#pragma once
#include "prdp/operators/operator.h"

namespace prdp {

/// Whether A, for each sample of b, is a sum of operators along the axes of its grid, which `Direct` solves without a
/// factorisation of the whole (kernels/fast_diagonalisation.h). False on other devices.
bool is_sum_over_axes(const Operator& a, const at::Tensor& b);

}  // namespace prdp
