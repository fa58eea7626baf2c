#include "prdp/operators/csr_operator.h"

#include <ATen/TensorSubclassLikeUtils.h>

#include <algorithm>

#include "prdp/error_text.h"
#include "prdp/gpu/operator_view.h"
#include "prdp/gpu/part_of.h"
#include "prdp/kernels/matrix.h"
#include "prdp/operators/dense.h"
#include "prdp/operators/matrix_checks.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/product_rule_kernels.h"
#include "prdp/threads/interruption.h"

namespace prdp {

namespace {

/// Raises ValueError unless these are the compressed rows of an n × n matrix: crow (n + 1), col (nnz).
void check_rows(const int64_t* crow, const int64_t* col, int64_t n, int64_t stored) {
  TORCH_CHECK_VALUE(crow[0] == 0 && crow[n] == stored, "linear_solve: crow of a CSR matrix must run from 0 to the ",
                    stored, " stored values, got ", crow[0], " to ", crow[n]);
  for (int64_t i = 0; i < n; ++i)
    TORCH_CHECK_VALUE(crow[i] <= crow[i + 1], "linear_solve: crow of a CSR matrix must not fall, got ", crow[i],
                      " before ", crow[i + 1], " at index ", i);
  // One comparison for both bounds, and no branch: the compiler makes vector code of it.
  bool inside = true;
  for (int64_t k = 0; k < stored; ++k) inside &= static_cast<uint64_t>(col[k]) < static_cast<uint64_t>(n);
  if (inside) return;
  for (int64_t k = 0; k < stored; ++k)
    TORCH_CHECK_VALUE(col[k] >= 0 && col[k] < n, "linear_solve: a column of a CSR matrix of ", n,
                      " rows must lie in [0, ", n, "), got ", col[k], " at index ", k);
}

}  // namespace

CsrOperator::CsrOperator(const OperatorSpec& spec) {
  TORCH_CHECK_VALUE(spec.tensors.size() == 3, "csr: takes three tensors, crow, col and values");
  const auto &crow = spec.tensors[0], &col = spec.tensors[1];
  values_ = spec.tensors[2];
  TORCH_CHECK_VALUE(values_.dim() == 1 || values_.dim() == 2,
                    "linear_solve: A must have shape (n, n) or (batch, n, n)");
  for (const auto* index : {&crow, &col})
    TORCH_CHECK_TYPE(index->scalar_type() == at::kInt || index->scalar_type() == at::kLong,
                     "linear_solve: indices of a CSR matrix must be int32 or int64, got ",
                     dtype_name(index->scalar_type()));
  TORCH_CHECK_VALUE(col.sym_size(-1) == values_.sym_size(-1),
                    "linear_solve: a CSR matrix needs as many columns as values, got ", col.sym_sizes(), " and ",
                    values_.sym_sizes());
  TORCH_CHECK_VALUE(crow.device() == values_.device() && col.device() == values_.device(),
                    "linear_solve: indices and values of a CSR matrix must be on one device, got ", crow.device(), ", ",
                    col.device(), " and ", values_.device());
  const bool batched = values_.dim() == 2;
  for (const auto* index : {&crow, &col})
    TORCH_CHECK_VALUE(index->dim() == 1 || (batched && index->dim() == 2 && index->sym_size(0) == values_.sym_size(0)),
                      "linear_solve: crow, col and values of a CSR matrix must have the same batch axis, but for "
                      "indices without one, "
                      "got ",
                      index->sym_sizes(), " and ", values_.sym_sizes());
  check_has_rows(crow.sym_size(-1) - 1);
  const auto for_values = [&](const at::Tensor& index) {
    // A conversion takes its time on a GPU: none where the dtype is right. But within a transform it wraps the index as
    // the values are wrapped.
    const auto whole = index.scalar_type() == at::kLong && !in_torch_func() ? index : index.to(at::kLong);
    return batched && whole.dim() == 1 ? whole.expand_symint({values_.sym_size(0), -1}) : whole;
  };
  crow_ = for_values(crow);
  col_ = for_values(col);
  drop_axis_of_one();
}

void CsrOperator::drop_axis_of_one() {
  if (values_.dim() == 1 || values_.sym_size(0) != 1) return;
  had_axis_of_one_ = true;
  for (auto* t : {&crow_, &col_, &values_}) *t = t->select(0, 0);
}

void CsrOperator::check_parameters(Checks checks) const {
  if (checks == Checks::kHost) return;
  // Tensors that stand for others while a graph is traced have no numbers yet: the op checks them when it runs.
  if (at::isTensorSubclassLike(crow_) || at::isTensorSubclassLike(col_) || crow_.is_meta()) return;
  const auto crow = crow_.to(at::kCPU).contiguous(), col = col_.to(at::kCPU).contiguous();
  const int64_t matrices = values_.dim() == 2 ? values_.size(0) : 1, stored = values_.size(-1);
  for (int64_t m = 0; m < matrices; ++m)
    check_rows(crow.const_data_ptr<int64_t>() + m * (n() + 1), col.const_data_ptr<int64_t>() + m * stored, n(), stored);
}

void CsrOperator::check_vector(const at::Tensor& b) const { check_matrix_vector(b, values_, n(), values_.dim() == 2); }

at::Tensor CsrOperator::rows() const {
  if (rows_.defined()) return rows_;
  const int64_t stored = values_.size(-1);
  if (crow_.is_cpu() && crow_.dim() == 1 && is_plain(crow_)) {
    rows_ = at::empty({stored}, crow_.options());
    const auto crow = crow_.contiguous();
    const auto* ends = crow.const_data_ptr<int64_t>() + 1;
    auto* row = rows_.mutable_data_ptr<int64_t>();
    for (int64_t i = 0, k = 0; i < n(); ++i)
      for (; k < std::min(ends[i], stored); ++k) row[k] = i;
    return rows_;
  }
  // Row of each stored entry: how many row ends lie at or before its position.
  const auto position = at::arange(stored, crow_.options());
  const auto ends = crow_.narrow(-1, 1, n()).contiguous();
  const auto wanted = values_.dim() == 2 ? position.expand_as(col_).contiguous() : position;
  return rows_ = at::searchsorted(ends, wanted, /*out_int32=*/false, /*right=*/true);
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

at::Tensor CsrOperator::norm() const { return largest_sum(rows()); }

at::Tensor CsrOperator::norm_of_transpose() const { return largest_sum(col_); }

at::Tensor CsrOperator::largest_sum(const at::Tensor& of_entries) const {
  auto shape = values_.sizes().vec();
  shape.back() = n();
  return at::zeros(shape, values_.options()).scatter_add(-1, of_entries, values_.abs()).amax(-1);
}

at::Tensor CsrOperator::to_dense() const {
  check_dense_fits(values_, n(), values_.dim() == 2 ? values_.size(0) : 1);
  auto shape = values_.sizes().vec();
  shape.back() = n() * n();
  const auto flat = at::zeros(shape, values_.options()).scatter_add(-1, rows() * n() + col_, values_);
  shape.back() = n();
  shape.push_back(n());
  return flat.view(shape);
}

at::Tensor CsrOperator::solve_directly(const at::Tensor& b, bool transposed) const {
  const auto matrix = to_dense();
  return solve_dense(transposed ? matrix.mT() : matrix, b.unsqueeze(-1)).squeeze(-1);
}

namespace {

/// Contiguous; one row for all where they share it.
at::Tensor shared_or_own(const at::Tensor& t) {
  if (t.dim() != 2 || t.stride(0) != 0 || t.stride(1) != 1) return t.contiguous();
  return gpu::part_of(t, t.storage_offset() * t.element_size(), t.size(1), t.scalar_type());
}
/// The step from the row of one matrix to that of the next.
int64_t step(const at::Tensor& t) { return t.dim() == 2 && t.size(0) > 1 ? t.stride(0) : 0; }

/// The cotangent of the values in one launch; undefined where there is no kernel.
template <class T>
at::Tensor product_rule_by_kernel(const at::Tensor& lambda, const at::Tensor& u, const at::Tensor& crow,
                                  const at::Tensor& col, const at::Tensor& values) {
  const auto out = at::empty(values.sizes(), values.options());
  const int64_t sets = values.dim() == 2 ? values.size(0) : 1;
  const gpu::CsrProductRule<T> of{pair_of<T>(lambda.unsqueeze(1), u.unsqueeze(1), sets),
                                  static_cast<int>(values.size(-1)),
                                  crow.const_data_ptr<int64_t>(),
                                  col.const_data_ptr<int64_t>(),
                                  step(crow),
                                  step(col),
                                  out.mutable_data_ptr<T>()};
  return gpu::each_point(out.device(), product_rule_body<T>("CsrProductRule"), of, out.numel()) ? out : at::Tensor();
}

/// The same in the host's memory: λ_i u_j of each sample, at the entries of its matrix or summed at those of all.
template <class T>
at::Tensor product_rule_by_loops(const at::Tensor& lambda, const at::Tensor& u, const at::Tensor& crow,
                                 const at::Tensor& col, const at::Tensor& values) {
  auto out = at::zeros(values.sizes(), values.options());
  const int64_t batch = u.size(0), n = u.size(1), stored = values.size(-1), own = values.dim() == 2;
  const int64_t rows_step = step(crow), columns_step = step(col);
  const auto *left = lambda.const_data_ptr<T>(), *right = u.const_data_ptr<T>();
  const auto *rows = crow.const_data_ptr<int64_t>(), *columns = col.const_data_ptr<int64_t>();
  T* const to = out.mutable_data_ptr<T>();
  constexpr int64_t worthwhile = int64_t{1} << 18;  // entries for a thread
  const int64_t grain = std::max<int64_t>(1, worthwhile * n / std::max<int64_t>(1, stored * batch));
  interruption::parallel_for(0, n, grain, [&](int64_t begin, int64_t end) {
    for (int64_t s = 0; s < batch; ++s)
      for (int64_t i = begin; i < end; ++i) {
        const auto *ends = rows + s * rows_step + i, *column = columns + s * columns_step;
        const T of_row = left[s * n + i];
        for (int64_t k = ends[0]; k < ends[1]; ++k) to[own * s * stored + k] += of_row * right[s * n + column[k]];
      }
  });
  return out;
}

}  // namespace

std::vector<at::Tensor> CsrOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  if (has_product_rule_kernel(lambda, u) && values_.numel() > 0) {
    const auto by_kernel =
        lambda.scalar_type() == at::kFloat ? product_rule_by_kernel<float> : product_rule_by_kernel<double>;
    const auto all = by_kernel(lambda.contiguous(), u.contiguous(), shared_or_own(crow_), shared_or_own(col_), values_);
    if (all.defined()) return {at::Tensor(), at::Tensor(), had_axis_of_one_ ? all.unsqueeze(0) : all};
  }
  // ∂⟨λ, A u⟩/∂A_ij = λ_i u_j at the stored entries, summed over the samples that share A
  const bool is_plain_product = is_plain(lambda) && is_plain(u) && all_plain({crow_, col_, values_});
  if (u.is_cpu() && is_plain_product && !at::GradMode::is_enabled() && !in_torch_func() &&
      lambda.sizes() == u.sizes()) {
    const auto by_loops = u.scalar_type() == at::kFloat ? product_rule_by_loops<float> : product_rule_by_loops<double>;
    const auto all = by_loops(lambda.contiguous(), u.contiguous(), shared_or_own(crow_), shared_or_own(col_), values_);
    return {at::Tensor(), at::Tensor(), had_axis_of_one_ ? all.unsqueeze(0) : all};
  }
  const auto col = col_.expand({u.size(0), -1});
  const auto row = rows().expand({u.size(0), -1});
  const auto outer = lambda.gather(1, row) * u.gather(1, col);
  if (values_.dim() == 2) return {at::Tensor(), at::Tensor(), outer};
  const auto of_all = outer.sum(0);
  return {at::Tensor(), at::Tensor(), had_axis_of_one_ ? of_all.unsqueeze(0) : of_all};
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
  chosen->rows_ = at::Tensor();
  chosen->drop_axis_of_one();
  return chosen;
}

std::shared_ptr<const kernels::Kernels> CsrOperator::kernels(const at::Tensor& b, bool transposed) const {
  const auto of_samples = [transposed, n = n(), crow = crow_.contiguous(), col = col_.contiguous(),
                           a = values_.detach().contiguous()]<class T>(T) -> kernels::KernelBatch<T> {
    const int64_t stored = a.size(-1);
    const bool own = a.dim() == 2 && a.size(0) > 1;
    const auto product = [=](int64_t s, const T* v, T* out) {
      const int64_t* rows = crow.template const_data_ptr<int64_t>() + own * s * (n + 1);
      const int64_t* columns = col.template const_data_ptr<int64_t>() + own * s * stored;
      const T* values = a.template const_data_ptr<T>() + own * s * stored;
      if (transposed) std::fill_n(out, n, T(0));
      for (int64_t i = 0; i < n; ++i) {
        T sum = 0;
        for (int64_t k = rows[i]; k < rows[i + 1]; ++k) {
          if (transposed) out[columns[k]] += values[k] * v[i];
          else sum += values[k] * v[columns[k]];
        }
        if (!transposed) out[i] = sum;
      }
    };
    const auto make = [=](int64_t s) -> std::unique_ptr<kernels::Kernel<T>> {
      const T* values = a.template const_data_ptr<T>() + own * s * stored;
      const T magnitude = kernels::largest_magnitude(values, stored);
      if (!std::isfinite(magnitude)) return nullptr;
      return std::make_unique<kernels::Csr<T>>(crow.template const_data_ptr<int64_t>() + own * s * (n + 1),
                                               col.template const_data_ptr<int64_t>() + own * s * stored, values, n,
                                               transposed, magnitude);
    };
    return {!own, make, product};
  };
  return kernels::make_kernels(b.scalar_type() == at::kFloat, of_samples);
}

std::optional<gpu::OperatorView> CsrOperator::gpu_view(const at::Tensor& b, bool transposed) const {
  auto crow = shared_or_own(crow_), col = shared_or_own(col_), values = values_.contiguous();
  if (transposed) {  // columns as rows
    col = col_.contiguous();
    const auto order = col.argsort(/*stable=*/true, /*dim=*/-1, /*descending=*/false);
    const auto along = [&](const at::Tensor& t) { return t.gather(-1, order); };
    auto bounds = at::arange(n() + 1, crow.options());
    if (col.dim() == 2) bounds = bounds.expand({col.size(0), -1}).contiguous();
    crow = at::searchsorted(along(col), bounds);
    col = along(rows());
    values = along(values);
  }
  gpu::OperatorView view{"Csr<" + gpu::type_of(b.scalar_type()) + ", " + std::to_string(n()) + ">"};
  view.numbers = {static_cast<double>(values.size(-1))};
  view.tensors = {crow, col, values};
  return view;
}

}  // namespace prdp
