#include "prdp/operators/singular_operator.h"

#include <algorithm>

#include "prdp/gpu/operator_view.h"
#include "prdp/gpu/part_of.h"
#include "prdp/kernels/kernel.h"
#include "prdp/operators/autocast.h"
#include "prdp/operators/dense.h"
#include "prdp/operators/diffusion_operator.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/remembered.h"
#include "prdp/operators/stencil_direct.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensor_factor_key.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

/// Whether no two of these rows, (…, k, n), have an entry at the same place.
bool are_disjoint(const at::Tensor& rows) { return rows.ne(0).sum(-2).le(1).all().item<bool>(); }

/// Orthonormal vectors in double by Gram and Schmidt, twice. `rows`: (k, n), or (batch, k, n), where a vector of zeros
/// remains.
at::Tensor orthonormalised(const at::Tensor& rows, const char* title) {
  const bool of_samples = rows.dim() == 3;
  std::vector<at::Tensor> done;
  const bool are_apart = are_disjoint(rows);
  for (int64_t k = 0; k < rows.size(-2); ++k) {
    auto q = rows.select(-2, k);
    const auto whole = q.norm(2, -1, /*keepdim=*/true);
    for (int pass = 0; pass < 2 && !are_apart; ++pass)
      for (const auto& other : done) q = q - (other * q).sum(-1, /*keepdim=*/true) * other;
    const auto left = q.norm(2, -1, /*keepdim=*/true);
    constexpr double independent = 1e-6;
    const auto remains = of_samples ? whole.eq(0) : at::zeros_like(whole, at::kBool);
    const auto wrong = (left > independent * whole).logical_or(remains).logical_not();
    if (wrong.any().item<bool>())
      TORCH_CHECK_VALUE(
          false, title, ": vector ", k, " of a null space",
          of_samples ? c10::str(" of sample ", wrong.flatten().to(at::kLong).argmax().item<int64_t>()) : "",
          " is zero, not finite, or depends on those before it");
    done.push_back(q / left.masked_fill(remains, 1.0));
  }
  return at::stack(done, -2);
}

/// orthonormalised() of disjoint rows, in a few operations however many there are. Nothing where a number is not finite
/// or a row is zero; of vectors that each sample has for itself, rows of zeros are allowed.
DisjointVectors disjoint_vectors(const at::Tensor& rows) {
  const auto vector = rows.ne(0).to(at::kByte).argmax(-2), entry = rows.sum(-2);
  const auto squares = at::zeros(rows.sizes().slice(0, rows.dim() - 1), rows.options());
  const auto norms = squares.scatter_add(-1, vector, entry * entry).sqrt();
  const bool all_are_there = rows.dim() == 3 || norms.gt(0).all().item<bool>();
  if (!all_are_there || !norms.isfinite().all().item<bool>()) return {};
  return {vector, entry / norms.masked_fill(norms.eq(0), 1.0).gather(-1, vector)};
}

/// What was found of the last tensor, as the steps of a flow have the same.
class LastDisjoint {
 public:
  DisjointVectors vectors;

  bool matches(const at::Tensor& t, bool of_samples) const {
    const bool is_there = !vectors || vectors.entry.device() == t.device();
    return !t.is_inference() && is_there && tensor_.matches(t) && of_samples_ == of_samples;
  }
  void store(const at::Tensor& t, bool of_samples, DisjointVectors found) {
    if (t.is_inference()) return;  // its version is not counted
    tensor_ = TensorFingerprint(t);
    of_samples_ = of_samples;
    vectors = std::move(found);
  }

 private:
  TensorFingerprint tensor_;
  bool of_samples_ = false;
};

/// v (batch, fields, n) without its parts along the vectors.
at::Tensor without_disjoint(const at::Tensor& v, const DisjointVectors& of, int64_t count) {
  const auto parts = v.flatten(0, -2).to(at::kDouble);
  const auto of_fields = [&](const at::Tensor& t) {
    return t.dim() == 1 ? t.expand_as(parts) : t.repeat_interleave(parts.size(0) / t.size(0), 0);
  };
  const auto vector = of_fields(of.vector), entry = of_fields(of.entry);
  const auto along = at::zeros({parts.size(0), count}, parts.options()).scatter_add(-1, vector, parts * entry);
  return (parts - along.gather(-1, vector) * entry).to(v.scalar_type()).view_as(v);
}

/// The vectors of a basis as the rows of a matrix, (k, n) or (batch, k, n).
at::Tensor rows_of(const at::Tensor& basis, bool of_samples) { return basis.flatten(of_samples ? 2 : 1); }

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
      right_{spec.tensors[spec.tensors.size() - 2].detach(), spec.tensors[spec.tensors.size() - 2]},
      left_{spec.tensors.back().detach(), spec.tensors.back()},
      needs_derivative_(any_needs_derivative(at::TensorList(spec.tensors).slice(spec.tensors.size() - 2))),
      title_(operator_kind(spec.kind).title) {
  // With more than two axes a basis counts its vectors along axis 0, or along axis 1 where each sample has its own;
  // only a vector tells which (check_vector()). So two such bases are refused here only if they differ along both axes.
  const auto has_axes = [](const Basis& basis) { return basis.given.dim() > 2; };
  const bool both = has_axes(right_) && has_axes(left_), any = has_axes(right_) || has_axes(left_);
  const bool differ_along_1 = both && right_.given.sym_size(1) != left_.given.sym_size(1);
  if (differ_along_1 || !any) check_counts(right_.count(/*axis=*/0), left_.count(0));
}

void SingularOperator::check_counts(const c10::SymInt& right, const c10::SymInt& left) const {
  TORCH_CHECK_VALUE(right == left, title_, ": nullspace and left_nullspace must hold as many vectors, got ", right,
                    " and ", left);
}

at::Tensor by_vector(const at::Tensor& v, bool spans_channels) {
  return spans_channels ? v.flatten(1).unsqueeze(1) : by_channel(v);
}

at::Tensor follow_null_space(const at::Tensor& u, const at::Tensor& basis) {
  const WithoutAutocast full_precision;
  const at::NoTF32Guard of_matrix_products;
  const bool of_samples = basis.dim() == u.dim() + 1;
  const auto parts = by_vector(u, of_samples || (u.dim() > 2 && basis.dim() == u.dim()));
  const auto rows = rows_of(basis, of_samples).to(u.scalar_type());
  const auto zeros = rows.detach().eq(0).all(-1).to(rows.scalar_type());
  const auto gram = at::matmul(rows, rows.mT()) + zeros.diag_embed();
  const auto along = at::linalg_solve(gram, at::matmul(parts, rows.mT()), /*left=*/false);  // zero, up to rounding
  return u - at::matmul(along, rows).reshape_as(u);
}

at::Tensor SingularOperator::orthonormal(const Basis& basis, const at::Tensor& v) const {
  if (basis.is_constant()) {
    const auto n = by_channel(v).sym_size(-1);
    return at::full_symint({1, n}, 1.0 / std::sqrt(static_cast<double>(n.expect_int())), v.options());
  }
  if (!basis.orthonormal.defined())
    basis.orthonormal = orthonormalised(rows_of(basis.given, basis.is_of_samples(v)).to(at::kDouble), title_);
  return basis.orthonormal.to(v.scalar_type());
}

const DisjointVectors& SingularOperator::disjoint(const Basis& basis, const at::Tensor& v) const {
  constexpr int64_t many = 4;
  if (basis.disjoint) return *basis.disjoint;
  basis.disjoint.emplace();
  const bool of_samples = basis.is_of_samples(v);
  if (basis.is_constant() || at::isTensorSubclassLike(basis.given) || basis.given.size(of_samples) < many)
    return *basis.disjoint;
  static thread_local LastDisjoint last;
  if (last.matches(basis.source, of_samples)) return *(basis.disjoint = last.vectors);
  const auto rows = rows_of(basis.given, of_samples).to(at::kDouble);
  if (are_disjoint(rows)) basis.disjoint = disjoint_vectors(rows);
  last.store(basis.source, of_samples, *basis.disjoint);
  return *basis.disjoint;
}

at::Tensor SingularOperator::without(const Basis& basis, const at::Tensor& v) const {
  const auto parts = by_vector(v, basis.spans_channels(v) || basis.is_of_samples(v));
  if (basis.is_constant()) return (parts - mean_in_order(parts, {-1})).reshape_as(v);
  if (const auto& vectors = disjoint(basis, v.detach()))
    return without_disjoint(parts, vectors, basis.given.size(basis.is_of_samples(v))).reshape_as(v);
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

/// (A + s Q_l Q_rᵀ)⁻¹ b with s = max |a_ij|, for a dense A that `product` gives column by column. The columns of Q_l
/// and Q_r, which are the rows of q_left and q_right, span the null spaces of Aᵀ and A. Callers project b before, u
/// after.
template <class Product>
at::Tensor solve_regular(const at::Tensor& b, const at::Tensor& q_right, const at::Tensor& q_left,
                         const Product& product) {
  const int64_t batch = b.size(0), n = b.numel() / std::max<int64_t>(batch, 1), channels = n / q_right.size(-1);
  check_dense_fits(b, n, batch);
  const auto a = matrix_by_columns(product, b);
  auto q = at::matmul(q_left.mT(), q_right);
  if (channels > 1) q = at::kron(at::eye(channels, b.options()), q);
  const auto scale = a.detach().abs().amax({-2, -1}, /*keepdim=*/true);
  return solve_dense(a + scale * q, b.flatten(1).unsqueeze(-1)).reshape_as(b);
}

}  // namespace

std::optional<at::Tensor> SingularOperator::solve_on_axes(const at::Tensor& b, bool transposed) const {
  if (b.is_cpu() || right_.spans_channels(b)) return std::nullopt;
  auto a = stencil_of(*a_);
  if (!a) return std::nullopt;
  a->transposed = transposed;
  const NamedNullSpace named{right_.count(right_.is_of_samples(b)).expect_int(),
                             right_.is_constant() && left_.is_constant()};
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
  if (!chosen) return nullptr;
  auto spec = spec_;
  for (size_t k = spec.tensors.size() - 2; k < spec.tensors.size(); ++k) {
    auto& basis = spec.tensors[k];
    const bool of_samples = basis.dim() == static_cast<int64_t>(vector_shape().size()) + 2;
    if (of_samples && basis.size(0) > 1) basis = basis.index_select(0, index.to(basis.device()));
  }
  return std::make_unique<SingularOperator>(std::move(chosen), spec);
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

namespace {

/// An orthonormal basis as numbers of the host.
class BasisOfSamples {
 public:
  /// (k, n), or (batch or 1, k, n).
  explicit BasisOfSamples(const at::Tensor& q)
      : count_(q.size(-2)), entries_((q.dim() == 2 ? q.unsqueeze(0) : q).to(at::kCPU, at::kDouble).contiguous()) {}
  BasisOfSamples(const DisjointVectors& q, int64_t count)
      : count_(count),
        entries_(at::atleast_2d(q.entry).to(at::kCPU).contiguous()),
        vector_(at::atleast_2d(q.vector).to(at::kCPU).contiguous()) {}
  /// The vectors of a sample, without those of zeros.
  std::vector<kernels::NullVector> of(int64_t s) const {
    const int64_t sample = entries_.size(0) == 1 ? 0 : s, n = entries_.size(-1);
    std::vector<kernels::NullVector> found(count_);
    if (vector_.defined()) {
      const double* entry = entries_.const_data_ptr<double>() + sample * n;
      const int64_t* vector = vector_.const_data_ptr<int64_t>() + sample * n;
      for (int64_t i = 0; i < n; ++i) add(found[vector[i]], i, entry[i]);
    } else {
      const double* entry = entries_.const_data_ptr<double>() + sample * count_ * n;
      for (auto& v : found)
        for (int64_t i = 0; i < n; ++i) add(v, i, *entry++);
    }
    std::erase_if(found, [](const kernels::NullVector& v) { return v.values.empty(); });
    return found;
  }

 private:
  static void add(kernels::NullVector& v, int64_t i, double entry) {
    if (entry == 0.0) return;
    if (v.values.empty()) v.begin = i;
    v.values.resize(i - v.begin);  // zeros between
    v.values.push_back(entry);
  }

  int64_t count_;
  at::Tensor entries_, vector_;
};

}  // namespace

std::shared_ptr<const kernels::Kernels> SingularOperator::kernels(const at::Tensor& b, bool transposed) const {
  const auto regular = a_->kernels(b, transposed);
  if (!regular) return nullptr;
  const auto vectors_of = [&](const Basis& basis) {
    const auto& vectors = disjoint(basis, b.detach());
    return vectors ? std::make_shared<const BasisOfSamples>(vectors, basis.given.size(basis.is_of_samples(b)))
                   : std::make_shared<const BasisOfSamples>(orthonormal(basis, b.detach()));
  };
  const auto right = vectors_of(transposed ? left_ : right_), left = vectors_of(transposed ? right_ : left_);
  const bool spans_channels = right_.spans_channels(b), of_samples = right_.is_of_samples(b);
  return std::visit(
      [&]<class T>(const kernels::KernelBatch<T>& batch) {
        const auto make = [regular, &batch, right, left, spans_channels](int64_t s) {
          auto a = batch.make(batch.is_shared ? 0 : s);
          const auto of_right = right->of(s);
          if (!a || of_right.empty()) return a;
          const auto& layout = a->layout();
          const int64_t fields = layout.planes, span = spans_channels ? fields : 1;
          a->set_null_spaces({layout, 0, fields, of_right, span}, {layout, 0, fields, left->of(s), span});
          a->set_needs_projection();
          return a;
        };
        return std::make_shared<const kernels::Kernels>(
            kernels::Kernels{kernels::KernelBatch<T>{batch.is_shared && !of_samples, make}});
      },
      regular->of_dtype);
}

}  // namespace prdp
