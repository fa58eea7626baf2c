#include "prdp/operators/dense.h"

#include <algorithm>
#include <limits>

#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

at::Tensor solve_plainly(const at::Tensor& matrix, const at::Tensor& b) {
  return std::get<0>(at::linalg_solve_ex(matrix, b));
}

/// With rows and columns brought to one size by powers of two, which change no digit but the choice of pivots.
template <class Solve>
at::Tensor solve_equilibrated(const at::Tensor& matrix, const at::Tensor& b, const Solve& solve) {
  const auto scale_of = [](const at::Tensor& a, int64_t along) {
    return power_of_two_scale(a.detach().abs().amax(along, /*keepdim=*/true));
  };
  const auto rows = scale_of(matrix, -1), columns = scale_of(rows * matrix, -2);
  return columns.mT() * solve(rows * matrix * columns, rows * b);
}

/// NaN where a pivot is rounding beside its own column, as the factorisations of the loops have it (kernels/
/// matrix_factors.cpp): A is singular, and its solution would be rounding.
at::Tensor solve_regular(const at::Tensor& matrix, const at::Tensor& b) {
  const auto [lu, pivots, info] = at::linalg_lu_factor_ex(matrix);
  const double rounding = epsilon_of(matrix) * static_cast<double>(matrix.size(-1));
  const auto size = matrix.detach().abs().sum(-2);
  const auto is_regular = lu.detach().diagonal(0, -2, -1).abs().gt(rounding * size).all();
  return at::where(is_regular, at::linalg_lu_solve(lu, pivots, b), std::numeric_limits<double>::quiet_NaN());
}

/// One matrix (n, n), in float64 whatever its dtype, and scaled where it seems singular as it is.
at::Tensor solve_on_cpu(const at::Tensor& matrix, const at::Tensor& b) {
  if (!is_plain(matrix) || !is_plain(b)) return solve_plainly(matrix, b);
  const auto a = matrix.to(at::kDouble), rhs = b.to(at::kDouble);
  auto x = solve_regular(a, rhs);
  if (x.isnan().any().item<bool>()) x = solve_equilibrated(a, rhs, solve_regular);
  return x.to(b.scalar_type());
}

}  // namespace

at::Tensor solve_dense(const at::Tensor& matrix, const at::Tensor& b) {
  if (!matrix.is_cpu()) return solve_equilibrated(matrix, b, solve_plainly);
  if (matrix.dim() < 3) return solve_on_cpu(matrix, b);
  if (matrix.size(0) == 1) return solve_on_cpu(matrix[0], b);
  // One at a time: after torch.set_num_threads, torch factors the matrices of a batch in threads that
  // spoil each other's pivots (pytorch issue 142815).
  std::vector<at::Tensor> solutions;
  for (int64_t i = 0; i < matrix.size(0); ++i) solutions.push_back(solve_on_cpu(matrix[i], b[i]));
  return solutions.empty() ? at::empty_like(b) : at::stack(solutions);
}

at::Tensor matrix_by_columns(const std::function<at::Tensor(const at::Tensor&)>& product, const at::Tensor& like) {
  const auto batch = like.size(0), n = like.numel() / std::max<int64_t>(batch, 1);
  std::vector<at::Tensor> columns;
  for (int64_t j = 0; j < n; ++j) {
    auto unit = at::zeros({batch, n}, like.options());
    unit.select(1, j).fill_(1.0);
    columns.push_back(product(unit.view(like.sizes())).reshape({batch, n}));
  }
  return at::stack(columns, -1);
}

void check_dense_fits(const at::Tensor& b, int64_t n, int64_t matrices) {
  // Beyond that the factors take longer than any iteration of the same system, whose vectors are n times smaller.
  constexpr int64_t most_unknowns = 4096, most_numbers = int64_t{1} << 26, few_unknowns = 256;
  if (b.is_cpu()) return;
  constexpr const char* instead =
      "take CG (if A is symmetric) or GMRES, with the preconditioner multigrid where the operator has it, or solve on "
      "the CPU";
  TORCH_CHECK_NOT_IMPLEMENTED(
      n <= most_unknowns && matrices * n * n <= most_numbers, "linear_solve: Direct on ", b.device(),
      " solves equations in 1D, stencils with constant coefficients in a box (sums of symmetric operators along the "
      "axes), and others of at most ",
      most_unknowns, " unknowns with ", most_numbers, " numbers in all matrices of a batch, got ", matrices,
      matrices == 1 ? " matrix" : " matrices", " of ", n, " unknowns; ", instead);
  if (n > few_unknowns) {
    TORCH_WARN_ONCE("prdp: Direct on ", b.device(), " has no fast way for this A, so it factors a dense matrix of ", n,
                    " unknowns, which is slow; ", instead);
  }
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
