#include "prdp/operators/singular_operator.h"

#include <algorithm>

#include "prdp/gpu/operator_view.h"
#include "prdp/gpu/part_of.h"
#include "prdp/kernels/kernel.h"
#include "prdp/operators/autocast.h"
#include "prdp/operators/dense.h"
#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/stencil_direct.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensor_factor_key.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

/// Orthonormal vectors in double by Gram and Schmidt, twice.
at::Tensor orthonormalised(const at::Tensor& rows, const char* title) {
  std::vector<at::Tensor> done;
  const bool are_apart = rows.ne(0).sum(0).le(1).all().item<bool>();  // such as those of the parts of a graph
  for (int64_t k = 0; k < rows.size(0); ++k) {
    auto q = rows[k];
    const auto whole = q.norm();
    for (int pass = 0; pass < 2 && !are_apart; ++pass)
      for (const auto& other : done) q = q - other.dot(q) * other;
    const auto left = q.norm();
    constexpr double independent = 1e-6;
    TORCH_CHECK_VALUE((left > independent * whole).item<bool>(), title, ": vector ", k,
                      " of a null space is zero, not finite, or depends on those before it");
    done.push_back(q / left);
  }
  return at::stack(done);
}

}  // namespace

OperatorSpec with_null_space(OperatorSpec a, const at::Tensor& right, std::optional<at::Tensor> left) {
  TORCH_CHECK_VALUE(!is_singular(a), "with_null_space: the operator has a null space already");
  const auto basis = [&](const at::Tensor& t) {
    return t.defined() ? t : at::empty({0}, a.tensors.empty() ? at::TensorOptions() : a.tensors.back().options());
  };
  const auto given = basis(right);
  a.tensors.insert(a.tensors.end(), {given, left ? basis(*left) : given});
  a.kind.insert(0, kSingular);
  return a;
}

SingularOperator::SingularOperator(std::unique_ptr<Operator> a, const OperatorSpec& spec)
    : a_(std::move(a)),
      spec_(spec),
      right_{spec.tensors[spec.tensors.size() - 2].detach(), {}},
      left_{spec.tensors.back().detach(), {}},
      needs_derivative_(any_needs_derivative(at::TensorList(spec.tensors).slice(spec.tensors.size() - 2))),
      title_(operator_kind(spec.kind).title) {
  TORCH_CHECK_VALUE(right_.count() == left_.count(), title_,
                    ": nullspace and left_nullspace must hold as many vectors, got ", right_.count(), " and ",
                    left_.count());
}

at::Tensor by_vector(const at::Tensor& v, bool spans_channels) {
  return spans_channels ? v.flatten(1).unsqueeze(1) : by_channel(v);
}

at::Tensor follow_null_space(const at::Tensor& u, const at::Tensor& basis) {
  const WithoutAutocast full_precision;
  const at::NoTF32Guard of_matrix_products;
  const auto parts = by_vector(u, u.dim() > 2 && basis.dim() == u.dim());
  const auto rows = basis.flatten(1).to(u.scalar_type());
  const auto gram = at::matmul(rows, rows.t());
  const auto along = at::linalg_solve(gram, at::matmul(parts, rows.t()), /*left=*/false);  // zero, up to rounding
  return u - at::matmul(along, rows).reshape_as(u);
}

at::Tensor SingularOperator::orthonormal(const Basis& basis, const at::Tensor& v) const {
  if (basis.is_constant()) {
    const auto n = by_channel(v).sym_size(-1);
    return at::full_symint({1, n}, 1.0 / std::sqrt(static_cast<double>(n.expect_int())), v.options());
  }
  if (!basis.orthonormal.defined()) basis.orthonormal = orthonormalised(basis.given.flatten(1).to(at::kDouble), title_);
  return basis.orthonormal.to(v.scalar_type());
}

at::Tensor SingularOperator::without(const Basis& basis, const at::Tensor& v) const {
  const auto parts = by_vector(v, basis.spans_channels(v));
  if (basis.is_constant()) return (parts - mean_in_order(parts, {-1})).reshape_as(v);
  const auto q = orthonormal(basis, v.detach());
  return without_parts(parts, q, q).reshape_as(v);
}

namespace {

/// The regular operator of a singular one as a stencil, if it is one.
std::optional<OperatorSpec> stencil_of(const Operator& a) {
  if (const auto* stencil = dynamic_cast<const StencilOperator*>(&a)) return stencil->spec();
  if (const auto* diffusion = dynamic_cast<const DiffusionOperator*>(&a)) return diffusion->as_stencil();
  return std::nullopt;
}

/// P_r (A + ‖A‖ Q_l Q_rᵀ)⁻¹ P_l b, where the columns of Q_l and Q_r span the null spaces of Aᵀ and A.
template <class Product>
at::Tensor solve_regular(const at::Tensor& b, const at::Tensor& q_right, const at::Tensor& q_left,
                         const Product& product) {
  const int64_t batch = b.size(0), n = b.numel() / std::max<int64_t>(batch, 1), channels = n / q_right.size(-1);
  check_dense_fits(b, n, batch);
  const auto a = matrix_by_columns(product, b);
  const auto q = at::kron(at::eye(channels, b.options()), at::matmul(q_left.mT(), q_right));
  const auto scale = a.detach().abs().amax({-2, -1}, /*keepdim=*/true);
  return solve_dense(a + scale * q, b.flatten(1).unsqueeze(-1)).reshape_as(b);
}

}  // namespace

std::optional<at::Tensor> SingularOperator::solve_on_axes(const at::Tensor& b, bool transposed) const {
  if (b.is_cpu() || right_.spans_channels(b)) return std::nullopt;
  auto a = stencil_of(*a_);
  if (!a) return std::nullopt;
  a->transposed = transposed;
  const NamedNullSpace named{right_.count().expect_int(), right_.is_constant() && left_.is_constant()};
  const auto u = solve_stencil_on_axes(*a, transposed ? project_solution(b) : project(b), named);
  return u ? std::optional(transposed ? project(*u) : project_solution(*u)) : std::nullopt;
}

at::Tensor SingularOperator::solve_directly(const at::Tensor& b, bool transposed) const {
  if (auto u = solve_on_axes(b, transposed)) return *std::move(u);
  const auto right = orthonormal(right_, b.detach()), left = orthonormal(left_, b.detach());
  if (transposed)
    return project(
        solve_regular(project_solution(b), left, right, [this](const at::Tensor& v) { return apply_transpose(v); }));
  return project_solution(solve_regular(project(b), right, left, [this](const at::Tensor& v) { return apply(v); }));
}

std::vector<at::Tensor> SingularOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  auto products = a_->product_rule(lambda, u);
  products.resize(products.size() + 2);
  return products;
}

std::unique_ptr<Operator> SingularOperator::select(const at::Tensor& index) const {
  auto chosen = a_->select(index);
  return chosen ? std::make_unique<SingularOperator>(std::move(chosen), spec_) : nullptr;
}

std::optional<kernels::FactorKey> SingularOperator::key(bool transposed) const {
  const auto regular = a_->key(transposed);
  if (!regular) return std::nullopt;
  kernels::FactorKeyMaker key;
  key.add(*regular).add(int64_t{transposed});
  for (const auto* basis : {&right_, &left_}) add_numbers(key.add(basis->given.dim()), basis->given);
  return key.key();
}

std::optional<gpu::OperatorView> SingularOperator::gpu_view(const at::Tensor& b, bool transposed) const {
  auto view = a_->gpu_view(b, transposed);
  if (!view) return view;
  const auto given = [&](const Basis& basis) {
    return basis.is_constant() ? gpu::part_of(b, 0, 0, b.scalar_type()) : orthonormal(basis, b.detach()).contiguous();
  };
  view->null_space = given(transposed ? left_ : right_);
  view->left_null_space = given(transposed ? right_ : left_);
  view->needs_projection = true;
  return view;
}

std::shared_ptr<const kernels::Kernels> SingularOperator::kernels(const at::Tensor& b, bool transposed) const {
  const auto regular = a_->kernels(b, transposed);
  if (!regular) return nullptr;
  const auto rows_of = [&](const Basis& basis) {
    const auto q = orthonormal(basis, b.detach()).to(at::kCPU, at::kDouble).contiguous();
    std::vector<std::vector<double>> rows;
    for (int64_t k = 0; k < q.size(0); ++k)
      rows.emplace_back(q[k].const_data_ptr<double>(), q[k].const_data_ptr<double>() + q.size(1));
    return rows;
  };
  const auto right = std::make_shared<const std::vector<std::vector<double>>>(rows_of(transposed ? left_ : right_));
  const auto left = std::make_shared<const std::vector<std::vector<double>>>(rows_of(transposed ? right_ : left_));
  const bool spans_channels = right_.spans_channels(b);
  return std::visit(
      [&]<class T>(const kernels::KernelBatch<T>& batch) {
        const auto make = [regular, &batch, right, left, spans_channels](int64_t s) {
          auto a = batch.make(s);
          if (!a) return a;
          const auto& layout = a->layout();
          const int64_t fields = layout.planes, span = spans_channels ? fields : 1;
          a->set_null_spaces({layout, 0, fields, *right, span}, {layout, 0, fields, *left, span});
          a->set_needs_projection();
          return a;
        };
        return std::make_shared<const kernels::Kernels>(
            kernels::Kernels{kernels::KernelBatch<T>{batch.is_shared, make}});
      },
      regular->of_dtype);
}

}  // namespace prdp
