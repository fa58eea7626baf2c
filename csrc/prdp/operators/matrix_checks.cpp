#include "prdp/operators/matrix_checks.h"

#include <c10/util/Exception.h>

#include "prdp/error_text.h"

namespace prdp {

void check_matrix_vector(const at::Tensor& b, const at::Tensor& values, int64_t n, bool batched) {
  TORCH_CHECK_VALUE(b.dim() == 2 && b.size(1) == n, "linear_solve: a matrix of ", n, " rows needs b of shape (", n,
                    ",) or (batch, ", n, "), got ", b.sizes(),
                    b.dim() == 3 && b.size(2) == n && !batched
                        ? "; the right-hand sides of one matrix are samples: b.flatten(0, 1)"
                    : b.dim() == 3 && (b.size(2) == n || b.size(1) == n)
                        ? in_language("; for several right-hand sides of a matrix, take torch.func.vmap over them", "")
                    : batched && b.dim() == 4 && b.size(2) == n && b.size(3) == n
                        ? "; if A is a field, give an operator that is made of it, such as Diffusion"
                    : b.dim() > 2 ? "; flatten b, or make the product a Function"
                                  : "");
  TORCH_CHECK_VALUE(!batched || b.size(0) == values.size(0), "linear_solve: A holds ", values.size(0),
                    " matrices, b holds ", b.size(0), " right-hand side", b.size(0) == 1 ? "" : "s",
                    b.size(0) == 1 ? "; expand b, so that each has its own" : "");
  TORCH_CHECK_TYPE(b.scalar_type() == at::kFloat || b.scalar_type() == at::kDouble,
                   "linear_solve: expected b in float32 or float64, got ", dtype_name(b.scalar_type()));
  TORCH_CHECK_TYPE(b.scalar_type() == values.scalar_type(), "linear_solve: A is ", dtype_name(values.scalar_type()),
                   " but b is ", dtype_name(b.scalar_type()));
  TORCH_CHECK_VALUE(b.device() == values.device(), "linear_solve: A is on ", values.device(), " but b is on ",
                    b.device());
}

void check_has_rows(const c10::SymInt& n) { TORCH_CHECK_VALUE(n >= 1, "linear_solve: A must have at least one row"); }

}  // namespace prdp
