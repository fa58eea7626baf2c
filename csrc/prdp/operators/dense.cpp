#include "prdp/operators/dense.h"

namespace prdp {

at::Tensor solve_dense(const at::Tensor& matrix, const at::Tensor& b) {
  if (matrix.dim() < 3 || matrix.size(0) == 1 || !matrix.is_cpu()) return std::get<0>(at::linalg_solve_ex(matrix, b));
  // One at a time: after torch.set_num_threads, torch factors the matrices of a batch in threads that
  // spoil each other's pivots (pytorch issue 142815).
  std::vector<at::Tensor> solutions;
  for (int64_t i = 0; i < matrix.size(0); ++i) solutions.push_back(std::get<0>(at::linalg_solve_ex(matrix[i], b[i])));
  return solutions.empty() ? at::empty_like(b) : at::stack(solutions);
}

at::Tensor channel_matrix(const Operator& a, const at::TensorOptions& options) {
  // Unit vectors as the channels of one field: row j of the product is column j of the matrix.
  auto shape = a.vector_shape();
  shape[0] = 1;
  for (size_t d = 1; d < shape.size(); ++d) shape[0] *= shape[d];
  const auto units = at::eye(shape[0], options).view(shape).unsqueeze(0);
  return a.apply(units).flatten(2).mT();
}

at::Tensor solve_channels(const at::Tensor& matrix, const at::Tensor& b) {
  return solve_dense(matrix, b.flatten(2).mT()).mT().reshape_as(b);
}

}  // namespace prdp
