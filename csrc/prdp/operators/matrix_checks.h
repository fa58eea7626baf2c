#pragma once
#include <ATen/core/Tensor.h>

namespace prdp {

/// Raises ValueError or TypeError unless b is (batch, n), of the matrix's dtype and device; `batched` tells whether A
/// has a batch axis.
void check_matrix_vector(const at::Tensor& b, const at::Tensor& values, int64_t n, bool batched);

/// Raises ValueError unless n >= 1.
void check_has_rows(const c10::SymInt& n);

}  // namespace prdp
