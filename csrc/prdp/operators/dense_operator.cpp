#include "prdp/operators/dense_operator.h"

#include <ATen/Context.h>

#include "prdp/gpu/operator_view.h"
#include "prdp/kernels/matrix.h"
#include "prdp/operators/dense.h"
#include "prdp/operators/matrix_checks.h"
#include "prdp/operators/plain_tensors.h"

namespace prdp {

namespace {

at::Tensor matvec(const at::Tensor& matrix, const at::Tensor& v) {
  // On CPUs torch multiplies a batch by a shared matrix that it repeats, from this size on by a library: that takes up
  // to five times as long as products one by one, and gives a sample bits that depend on its neighbours.
  constexpr int64_t by_a_library = 20;
  if (matrix.dim() == 2 && v.dim() == 2 && v.is_cpu() && is_plain(matrix) && is_plain(v) && v.size(0) > 0 &&
      v.size(1) >= by_a_library) {
    std::vector<at::Tensor> products;
    for (const auto& sample : v.unbind()) products.push_back(at::mv(matrix, sample.clone()));  // all aligned alike
    return at::stack(products);
  }
  const at::NoTF32Guard full_precision;
  return at::matmul(matrix, v.unsqueeze(-1)).squeeze(-1);
}

}  // namespace

DenseOperator::DenseOperator(const OperatorSpec& spec) {
  TORCH_CHECK_VALUE(spec.tensors.size() == 1, "dense: takes one tensor, the matrix");
  matrix_ = spec.tensors[0];
  const auto dim = matrix_.dim();
  TORCH_CHECK_VALUE((dim == 2 || dim == 3) && matrix_.sym_size(-1) == matrix_.sym_size(-2),
                    "linear_solve: A must have shape (n, n) or (batch, n, n), got ", matrix_.sym_sizes());
  check_has_rows(matrix_.sym_size(-1));
  drop_axis_of_one();
}

void DenseOperator::drop_axis_of_one() {
  if (matrix_.dim() == 2 || matrix_.sym_size(0) != 1) return;
  had_axis_of_one_ = true;
  matrix_ = matrix_.select(0, 0);
}

void DenseOperator::check_vector(const at::Tensor& b) const {
  check_matrix_vector(b, matrix_, matrix_.size(-1), matrix_.dim() == 3);
}

at::Tensor DenseOperator::apply(const at::Tensor& v) const { return matvec(matrix_, v); }
at::Tensor DenseOperator::apply_transpose(const at::Tensor& v) const { return matvec(matrix_.mT(), v); }
at::Tensor DenseOperator::diagonal() const { return matrix_.diagonal(0, -2, -1); }
at::Tensor DenseOperator::norm() const { return matrix_.abs().sum(-1).amax(-1); }

at::Tensor DenseOperator::norm_of_transpose() const { return matrix_.abs().sum(-2).amax(-1); }

at::Tensor DenseOperator::solve_directly(const at::Tensor& b, bool transposed) const {
  // A singular matrix gives numbers that are not finite; TensorSpace::solve_directly() calls that a breakdown.
  return solve_dense(transposed ? matrix_.mT() : matrix_, b.unsqueeze(-1)).squeeze(-1);
}

std::vector<at::Tensor> DenseOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  // ∂⟨λ, A u⟩/∂A = λ uᵀ, summed over the samples that share A
  if (matrix_.dim() == 3) return {lambda.unsqueeze(-1) * u.unsqueeze(-2)};
  const at::NoTF32Guard full_precision;
  const auto of_all = at::matmul(lambda.mT(), u);
  return {had_axis_of_one_ ? of_all.unsqueeze(0) : of_all};
}

std::vector<int64_t> DenseOperator::first_nonfinite(int64_t sample) const {
  return first_true(nonfinite(matrix_.dim() == 3 ? matrix_.select(0, sample) : matrix_));
}

std::unique_ptr<Operator> DenseOperator::select(const at::Tensor& index) const {
  auto chosen = std::make_unique<DenseOperator>(*this);
  if (matrix_.dim() == 2) return chosen;
  chosen->matrix_ = matrix_.index_select(0, index);
  chosen->drop_axis_of_one();
  return chosen;
}

std::optional<gpu::OperatorView> DenseOperator::gpu_view(const at::Tensor& b, bool transposed) const {
  const auto n = matrix_.size(-1);
  gpu::OperatorView view{"Dense<" + gpu::type_of(b.scalar_type()) + ", " + std::to_string(n) + ", " +
                         std::to_string(transposed) + ">"};
  view.tensors = {matrix_.contiguous().view({-1, n, n})};
  return view;
}

std::shared_ptr<const kernels::Kernels> DenseOperator::kernels(const at::Tensor& b, bool transposed) const {
  const auto of_samples = [transposed, a = matrix_.detach().contiguous()]<class T>(T) -> kernels::KernelBatch<T> {
    const int64_t n = a.size(-1), stride = a.dim() == 3 && a.size(0) > 1 ? n * n : 0;
    return {stride == 0, [=](int64_t s) -> std::unique_ptr<kernels::Kernel<T>> {
              const T* values = a.template const_data_ptr<T>() + s * stride;
              const T magnitude = kernels::largest_magnitude(values, n * n);
              if (!std::isfinite(magnitude)) return nullptr;
              return std::make_unique<kernels::Dense<T>>(values, n, transposed, magnitude);
            }};
  };
  return kernels::make_kernels(b.scalar_type() == at::kFloat, of_samples);
}

}  // namespace prdp
