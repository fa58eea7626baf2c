#include "prdp/operators/dense.h"

#include <ATen/ops/linalg_solve_ex.h>
#include <ATen/ops/stack.h>
#include <ATen/ops/empty_like.h>

namespace prdp {

at::Tensor solve_dense(const at::Tensor& matrix, const at::Tensor& b) {
  if (matrix.dim() < 3 || matrix.size(0) == 1 || !matrix.is_cpu())
    return std::get<0>(at::linalg_solve_ex(matrix, b));
  // One at a time: after torch.set_num_threads, torch factors the matrices of a batch in threads that
  // spoil each other's pivots (pytorch issue 142815).
  std::vector<at::Tensor> solutions;
  for (int64_t i = 0; i < matrix.size(0); ++i)
    solutions.push_back(std::get<0>(at::linalg_solve_ex(matrix[i], b[i])));
  return solutions.empty() ? at::empty_like(b) : at::stack(solutions);
}

}  // namespace prdp
