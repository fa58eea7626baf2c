#include "prdp/operators/matrix_operator.h"

#include "prdp/operators/dense.h"

namespace prdp {

namespace {

/// b must be (batch, n), of the matrix's dtype and device; `batched` tells whether A has a batch axis.
void check_matrix_vector(const at::Tensor& b, const at::Tensor& values, int64_t n, bool batched) {
  TORCH_CHECK_VALUE(b.dim() == 2 && b.size(1) == n, "linear_solve: a matrix of ", n,
                    " rows needs b of shape (", n, ",) or (batch, ", n, "), got ", b.sizes());
  TORCH_CHECK_VALUE(!batched || b.size(0) == values.size(0), "linear_solve: A holds ",
                    values.size(0), " matrices, b holds ", b.size(0), " right-hand sides");
  TORCH_CHECK_TYPE(b.scalar_type() == at::kFloat || b.scalar_type() == at::kDouble,
                   "linear_solve: expected float32 or float64, got ", b.scalar_type());
  TORCH_CHECK_TYPE(b.scalar_type() == values.scalar_type(), "linear_solve: A is ",
                   values.scalar_type(), " but b is ", b.scalar_type());
  TORCH_CHECK_VALUE(b.device() == values.device(), "linear_solve: A is on ", values.device(),
                    " but b is on ", b.device());
}

at::Tensor matvec(const at::Tensor& matrix, const at::Tensor& v) {
  return at::matmul(matrix, v.unsqueeze(-1)).squeeze(-1);
}

at::Tensor solve_matrix(const at::Tensor& matrix, const at::Tensor& b) {
  // A singular matrix gives a non-finite solution here, and a status there.
  return solve_dense(matrix, b.unsqueeze(-1)).squeeze(-1);
}

}  // namespace

DenseOperator::DenseOperator(const OperatorSpec& spec) {
  TORCH_CHECK_VALUE(spec.tensors.size() == 1, "dense: takes one tensor, the matrix");
  matrix_ = spec.tensors[0];
  const auto dim = matrix_.dim();
  TORCH_CHECK_VALUE((dim == 2 || dim == 3) && matrix_.sym_size(-1) == matrix_.sym_size(-2),
                    "linear_solve: A must have shape (n, n) or (batch, n, n), got ",
                    matrix_.sym_sizes());
}

void DenseOperator::check_vector(const at::Tensor& b) const {
  check_matrix_vector(b, matrix_, matrix_.size(-1), matrix_.dim() == 3);
}

at::Tensor DenseOperator::apply(const at::Tensor& v) const { return matvec(matrix_, v); }
at::Tensor DenseOperator::apply_transpose(const at::Tensor& v) const {
  return matvec(matrix_.mT(), v);
}
at::Tensor DenseOperator::diagonal() const { return matrix_.diagonal(0, -2, -1); }
at::Tensor DenseOperator::norm() const { return matrix_.abs().sum(-1).amax(-1); }

at::Tensor DenseOperator::solve_directly(const at::Tensor& b) const {
  return solve_matrix(matrix_, b);
}
at::Tensor DenseOperator::solve_transpose_directly(const at::Tensor& b) const {
  return solve_matrix(matrix_.mT(), b);
}

std::vector<at::Tensor> DenseOperator::product_rule(const at::Tensor& lambda,
                                                    const at::Tensor& u) const {
  // ∂⟨λ, A u⟩/∂A = λ uᵀ, summed over the samples that share A
  if (matrix_.dim() == 2) return {at::matmul(lambda.mT(), u)};
  if (matrix_.sym_size(0) == 1) return {at::matmul(lambda.mT(), u).unsqueeze(0)};
  return {lambda.unsqueeze(-1) * u.unsqueeze(-2)};
}

std::vector<int64_t> DenseOperator::first_nonfinite(int64_t sample) const {
  return first_true(nonfinite(matrix_.dim() == 3 ? matrix_.select(0, sample) : matrix_));
}

std::unique_ptr<Operator> DenseOperator::select(const at::Tensor& index) const {
  auto chosen = std::make_unique<DenseOperator>(*this);
  if (matrix_.dim() == 3) chosen->matrix_ = matrix_.index_select(0, index);
  return chosen;
}

KernelParameters DenseOperator::kernel(const at::Tensor&) const { return DenseParameters{matrix_.contiguous()}; }

CsrOperator::CsrOperator(const OperatorSpec& spec) {
  TORCH_CHECK_VALUE(spec.tensors.size() == 3, "csr: takes three tensors, crow, col and values");
  crow_ = spec.tensors[0].to(at::kLong);
  col_ = spec.tensors[1].to(at::kLong);
  values_ = spec.tensors[2];
  TORCH_CHECK_VALUE(values_.dim() == 1 || values_.dim() == 2,
                    "linear_solve: A must have shape (n, n) or (batch, n, n)");
}

void CsrOperator::check_vector(const at::Tensor& b) const {
  check_matrix_vector(b, values_, n(), values_.dim() == 2);
}

at::Tensor CsrOperator::rows() const {
  // Row of each stored entry: how many row ends lie at or before its position.
  const auto position = at::arange(values_.size(-1), crow_.options());
  const auto ends = crow_.narrow(-1, 1, n()).contiguous();
  const auto wanted = values_.dim() == 2 ? position.expand_as(col_).contiguous() : position;
  return at::searchsorted(ends, wanted, /*out_int32=*/false, /*right=*/true);
}

at::Tensor CsrOperator::apply(const at::Tensor& v) const {
  const auto col = col_.expand({v.size(0), -1});
  const auto row = rows().expand({v.size(0), -1});
  return at::zeros_like(v).scatter_add(1, row, values_ * v.gather(1, col));
}

at::Tensor CsrOperator::apply_transpose(const at::Tensor& v) const {
  const auto col = col_.expand({v.size(0), -1});
  const auto row = rows().expand({v.size(0), -1});
  return at::zeros_like(v).scatter_add(1, col, values_ * v.gather(1, row));
}

at::Tensor CsrOperator::diagonal() const {
  const auto row = rows();
  const auto on_diagonal = at::where(row == col_, values_, at::zeros_like(values_));
  auto shape = values_.sizes().vec();
  shape.back() = n();
  return at::zeros(shape, values_.options()).scatter_add(-1, row, on_diagonal);
}

at::Tensor CsrOperator::norm() const {
  auto shape = values_.sizes().vec();
  shape.back() = n();
  return at::zeros(shape, values_.options()).scatter_add(-1, rows(), values_.abs()).amax(-1);
}

at::Tensor CsrOperator::to_dense() const {
  auto shape = values_.sizes().vec();
  shape.back() = n() * n();
  const auto flat = at::zeros(shape, values_.options()).scatter_add(-1, rows() * n() + col_, values_);
  shape.back() = n();
  shape.push_back(n());
  return flat.view(shape);
}

at::Tensor CsrOperator::solve_directly(const at::Tensor& b) const {
  return solve_matrix(to_dense(), b);
}
at::Tensor CsrOperator::solve_transpose_directly(const at::Tensor& b) const {
  return solve_matrix(to_dense().mT(), b);
}

std::vector<at::Tensor> CsrOperator::product_rule(const at::Tensor& lambda,
                                                  const at::Tensor& u) const {
  // ∂⟨λ, A u⟩/∂A_ij = λ_i u_j at the stored entries, summed over the samples that share A
  const auto col = col_.expand({u.size(0), -1});
  const auto row = rows().expand({u.size(0), -1});
  const auto outer = lambda.gather(1, row) * u.gather(1, col);
  const bool shared = values_.dim() == 1 || values_.size(0) == 1;
  return {at::Tensor(), at::Tensor(), shared ? outer.sum(0).view_as(values_) : outer};
}

std::vector<int64_t> CsrOperator::first_nonfinite(int64_t sample) const {
  const bool batched = values_.dim() == 2;
  const auto k = first_true(nonfinite(batched ? values_.select(0, sample) : values_))[0];
  const auto row = batched ? rows().select(0, sample) : rows();
  const auto col = batched ? col_.select(0, sample) : col_;
  return {row[k].item<int64_t>(), col[k].item<int64_t>()};
}

std::unique_ptr<Operator> CsrOperator::select(const at::Tensor& index) const {
  auto chosen = std::make_unique<CsrOperator>(*this);
  if (values_.dim() == 1) return chosen;
  chosen->crow_ = crow_.index_select(0, index);
  chosen->col_ = col_.index_select(0, index);
  chosen->values_ = values_.index_select(0, index);
  return chosen;
}

KernelParameters CsrOperator::kernel(const at::Tensor&) const {
  return CsrParameters{crow_.contiguous(), col_.contiguous(), values_.contiguous()};
}

}  // namespace prdp
