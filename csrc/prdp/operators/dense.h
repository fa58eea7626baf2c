#pragma once
#include <functional>

#include "prdp/operators/operator.h"

namespace prdp {

/// A⁻¹ b by LU with partial pivoting, for a matrix (n, n), (1, n, n) or (batch, n, n) and b (batch, n, k). A singular
/// matrix gives values that are not finite, and no exception.
at::Tensor solve_dense(const at::Tensor& matrix, const at::Tensor& b);

/// The matrix (batch, n, n) of a product with vectors like this one, (batch, ...), one unit vector at a time.
at::Tensor matrix_by_columns(const std::function<at::Tensor(const at::Tensor&)>& product, const at::Tensor& like);

/// Raises NotImplementedError where b is not on the CPU and so many dense matrices of n rows, made of an operator that
/// was not given as one, would take too long to factorise or too much memory.
void check_dense_fits(const at::Tensor& b, int64_t n, int64_t matrices);

/// The matrix (batch or 1, n, n) of an operator that acts on each channel of a field of n points
/// alike. Differentiable.
at::Tensor channel_matrix(const Operator& a, const at::TensorOptions& options);
/// The solutions for each channel of b (batch, channel, *shape).
at::Tensor solve_channels(const at::Tensor& matrix, const at::Tensor& b);

}  // namespace prdp
