#include "prdp/operators/operator.h"

#include "prdp/gpu/operator_view.h"
#include "prdp/kernels/factor_cache.h"
#include "prdp/operators/dense.h"
#include "prdp/operators/singular_operator.h"

namespace prdp {

std::vector<int64_t> first_true(const at::Tensor& mask) {
  auto flat = mask.reshape(-1).to(at::kByte).argmax().item<int64_t>();
  std::vector<int64_t> index(mask.dim());
  for (int64_t d = mask.dim() - 1; d >= 0; --d) {
    index[d] = flat % mask.size(d);
    flat /= mask.size(d);
  }
  return index;
}

at::Tensor nonfinite(const at::Tensor& t) { return t.isfinite().logical_not(); }

at::Tensor Operator::dense(const at::TensorOptions& options) const {
  auto shape = vector_shape();
  // One unit vector at a time: an operator with a batch axis takes the same one for every sample.
  const auto batch = norm().dim() == 0 ? 1 : norm().size(0);
  shape.insert(shape.begin(), batch);
  const auto matrix = matrix_by_columns([this](const at::Tensor& v) { return apply(v); }, at::empty(shape, options));
  return batch == 1 && norm().dim() == 0 ? matrix.squeeze(0) : matrix;
}

std::shared_ptr<const kernels::Kernels> Operator::kernels(const at::Tensor&, bool) const { return nullptr; }
std::optional<kernels::FactorKey> Operator::key(bool) const { return std::nullopt; }
std::optional<gpu::OperatorView> Operator::gpu_view(const at::Tensor&, bool) const { return std::nullopt; }

at::Tensor Operator::jacobi_radius() const {
  TORCH_CHECK_VALUE(false,
                    "Chebyshev: the spectrum is known of Heat and Poisson operators alone; "
                    "for others take CG or GMRES");
}

namespace {

/// Aᵀ of any operator.
class Transposed final : public Operator {
 public:
  explicit Transposed(std::unique_ptr<Operator> a) : a_(std::move(a)) {}
  void check_vector(const at::Tensor& b) const override { a_->check_vector(b); }
  void check_parameters(Checks checks) const override { a_->check_parameters(checks); }
  std::string refusal(int64_t sample) const override { return a_->refusal(sample); }
  void check_null_spaces(const at::Tensor& b) const override { a_->check_null_spaces(b); }
  at::Tensor apply(const at::Tensor& v) const override { return a_->apply_transpose(v); }
  at::Tensor apply_transpose(const at::Tensor& v) const override { return a_->apply(v); }
  at::Tensor diagonal() const override { return a_->diagonal(); }
  std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const override {
    return a_->product_rule(u, lambda);  // ⟨λ, Aᵀ u⟩ = ⟨u, A λ⟩
  }
  at::Tensor project(const at::Tensor& v) const override { return a_->project_solution(v); }
  at::Tensor project_solution(const at::Tensor& v) const override { return a_->project(v); }
  bool needs_projection() const override { return a_->needs_projection(); }
  bool may_be_singular() const override { return a_->may_be_singular(); }
  at::Tensor jacobi_radius() const override { return a_->jacobi_radius(); }
  bool knows_jacobi_radius() const override { return a_->knows_jacobi_radius(); }
  at::Tensor norm() const override { return a_->norm_of_transpose(); }
  at::Tensor norm_of_transpose() const override { return a_->norm(); }
  std::vector<int64_t> vector_shape() const override { return a_->vector_shape(); }
  at::Tensor solve_directly(const at::Tensor& b, bool transposed) const override {
    return a_->solve_directly(b, !transposed);
  }
  std::unique_ptr<Operator> select(const at::Tensor& index) const override {
    auto chosen = a_->select(index);
    return chosen ? std::make_unique<Transposed>(std::move(chosen)) : nullptr;
  }
  at::Tensor nonfinite_samples(const at::Tensor& b) const override { return a_->nonfinite_samples(b); }
  std::vector<int64_t> first_nonfinite(int64_t sample) const override { return a_->first_nonfinite(sample); }
  bool has_coarse_grids() const override { return a_->has_coarse_grids(); }
  bool has_multigrid_preconditioner() const override { return a_->has_multigrid_preconditioner(); }
  std::shared_ptr<const kernels::Kernels> kernels(const at::Tensor& b, bool transposed) const override {
    return a_->kernels(b, !transposed);
  }
  std::optional<kernels::FactorKey> key(bool transposed) const override { return a_->key(!transposed); }
  std::optional<gpu::OperatorView> gpu_view(const at::Tensor& b, bool transposed) const override {
    return a_->gpu_view(b, !transposed);
  }

 private:
  std::unique_ptr<Operator> a_;
};

}  // namespace

std::unique_ptr<Operator> make_operator(const OperatorSpec& spec) {
  const auto& kind = operator_kind(spec.kind);
  std::unique_ptr<Operator> a;
  if (is_singular(spec)) {
    TORCH_CHECK_VALUE(spec.tensors.size() >= 2, kind.title, ": its null spaces are missing");
    auto regular = spec;
    regular.tensors.resize(spec.tensors.size() - 2);
    a = std::make_unique<SingularOperator>(kind.make(regular), spec);
  } else {
    a = kind.make(spec);
  }
  if (spec.transposed) return std::make_unique<Transposed>(std::move(a));
  return a;
}

}  // namespace prdp
