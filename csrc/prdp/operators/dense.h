#pragma once

#include <ATen/core/Tensor.h>

namespace prdp {

/// A⁻¹ b by LU with partial pivoting: matrix (n, n), (1, n, n) or (batch, n, n), b (batch, n, k). A
/// singular matrix gives values that are not finite, and no exception.
at::Tensor solve_dense(const at::Tensor& matrix, const at::Tensor& b);

}  // namespace prdp
