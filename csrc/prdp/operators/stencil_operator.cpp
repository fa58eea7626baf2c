#include "prdp/operators/stencil_operator.h"

#include <algorithm>
#include <cmath>

#include "prdp/gpu/kernel_text.h"
#include "prdp/gpu/operator_view.h"
#include "prdp/kernels/given_stencil.h"
#include "prdp/kernels/kernel.h"
#include "prdp/operators/stencil_direct.h"
#include "prdp/operators/tensor_factor_key.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

constexpr int64_t kItself = 0;  // the place of the point itself in StencilSparsity::offsets

/// The neighbours on the other side, which are those of the transpose.
std::vector<kernels::Offset> negated(std::vector<kernels::Offset> offsets) {
  for (auto& offset : offsets)
    for (auto& cells : offset.along) cells = -cells;
  return offsets;
}

}  // namespace

at::Tensor StencilOperator::shifted(const at::Tensor& t, const kernels::Offset& offset, bool back) const {
  auto moved = t;
  for (int64_t axis = 0; axis < dim(); ++axis) {
    const int64_t cells = (back ? -1 : 1) * offset.along[zyx(axis)], n = extent(axis);
    const int64_t d = t.dim() - dim() + axis;
    if (cells == 0) continue;
    if (grid_.periodic[zyx(axis)]) {
      moved = at::roll(moved, -cells, d);
      continue;
    }
    const int64_t kept = std::max<int64_t>(n - std::abs(cells), 0), before = cells < 0 ? n - kept : 0;
    const int64_t behind = cells > 0 ? n - kept : 0;
    moved = padded(moved.narrow(d, behind, kept), d, before, behind);
  }
  return moved;
}

at::Tensor StencilOperator::apply(const at::Tensor& v) const {
  at::Tensor sum;
  for (int64_t k = 0; k < count(); ++k) add_to(sum, coefficient(k) * shifted(v, offsets_[k]));
  return sum;
}

at::Tensor StencilOperator::apply_transpose(const at::Tensor& v) const {
  at::Tensor sum;
  for (int64_t k = 0; k < count(); ++k) add_to(sum, shifted(coefficient(k) * v, offsets_[k], /*back=*/true));
  return sum;
}

at::Tensor StencilOperator::diagonal() const {
  const kernels::StencilSparsity pattern(grid_, offsets_);
  at::Tensor sum;
  for (int64_t k = 0; k < count(); ++k)
    if (pattern.places[k] == kItself) add_to(sum, coefficient(k));
  return sum.defined() ? sum : at::zeros_like(coefficient(0));
}

at::Tensor StencilOperator::norm() const { return norm_of(/*transposed=*/false); }

at::Tensor StencilOperator::norm_of_transpose() const { return norm_of(/*transposed=*/true); }

at::Tensor StencilOperator::norm_of(bool transposed) const {
  const kernels::StencilSparsity pattern(grid_, offsets_);
  const auto inside = at::ones(coefficients_.sizes().slice(2), coefficients_.options());
  std::vector<at::Tensor> entries(pattern.offsets.size());
  auto rows = coefficients_.mul(0).sum(1);  // NaN where a coefficient is not finite
  for (int64_t k = 0; k < count(); ++k)
    if (const int64_t place = pattern.places[k]; place >= 0)
      add_to(entries[place], coefficient(k).squeeze(1) * shifted(inside, offsets_[k]));
  for (size_t place = 0; place < entries.size(); ++place) {
    if (!entries[place].defined()) continue;
    const auto size = entries[place].abs();
    rows = rows + (transposed ? shifted(size, pattern.offsets[place], /*back=*/true) : size);
  }
  const auto norms = rows.flatten(1).amax(1);
  return norms.size(0) == 1 ? norms.squeeze(0) : norms;
}

at::Tensor StencilOperator::solve_directly(const at::Tensor& b, bool transposed) const {
  auto a = spec();
  a.transposed = transposed;
  return solve_stencil_directly(a, b);
}

OperatorSpec StencilOperator::spec() const {
  OperatorSpec spec{"stencil", {grid_.shape + zyx(0), grid_.shape + 3}, {}, {coefficients_}};
  for (int64_t axis = 0; axis < dim(); ++axis) spec.parameters.push_back(grid_.periodic[zyx(axis)]);
  for (const auto& offset : offsets_)
    for (int64_t axis = 0; axis < dim(); ++axis)
      spec.parameters.push_back(static_cast<double>(offset.along[zyx(axis)]));
  return spec;
}

at::Tensor StencilOperator::nearest_coefficients(bool transposed) const {
  const auto offsets = transposed ? negated(offsets_) : offsets_;
  const kernels::StencilSparsity pattern(grid_, offsets);
  if (!pattern.nearest) return {};
  std::vector<at::Tensor> fields(1 + 2 * dim());
  for (int64_t k = 0; k < count(); ++k) {
    const int64_t place = pattern.places[k];
    if (place < 0) continue;
    const auto given = coefficients_.select(1, k);
    const int64_t axis = dim() - 1 - (place - 1) / 2;  // the neighbours along x come first
    add_to(fields[place == kItself ? 0 : 1 + 2 * axis + (place - 1) % 2],
           transposed ? shifted(given, offsets_[k], /*back=*/true) : given);
  }
  for (auto& field : fields)
    if (!field.defined()) field = at::zeros_like(coefficients_.select(1, 0));
  const auto all = at::stack(fields, 1);
  for (int64_t axis = 0; axis < dim(); ++axis) {
    if (grid_.periodic[zyx(axis)]) continue;
    all.select(1, 1 + 2 * axis).narrow(1 + axis, 0, 1).zero_();
    all.select(1, 2 + 2 * axis).narrow(1 + axis, extent(axis) - 1, 1).zero_();
  }
  return all;
}

std::vector<int64_t> StencilOperator::first_nonfinite(int64_t sample) const {
  return first_true(nonfinite(coefficients_.select(0, coefficients_.size(0) == 1 ? 0 : sample)));
}

std::unique_ptr<Operator> StencilOperator::select(const at::Tensor& index) const {
  auto chosen = std::make_unique<StencilOperator>(*this);
  if (coefficients_.size(0) > 1) chosen->coefficients_ = coefficients_.index_select(0, index);
  return chosen;
}

std::vector<int64_t> StencilOperator::vector_shape() const {
  std::vector<int64_t> shape{1};
  for (int64_t d = 0; d < dim(); ++d) shape.push_back(extent(d));
  return shape;
}

bool StencilOperator::has_coarse_grids() const {
  const kernels::StencilSparsity pattern(grid_, offsets_);
  return std::all_of(pattern.offsets.begin(), pattern.offsets.end(), [](const kernels::Offset& o) {
    return std::all_of(std::begin(o.along), std::end(o.along), [](int64_t cells) { return std::abs(cells) <= 1; });
  });
}

std::shared_ptr<const kernels::Kernels> StencilOperator::kernels(const at::Tensor& b, bool transposed) const {
  return kernels_of(b, transposed, at::Tensor());
}

std::shared_ptr<const kernels::Kernels> StencilOperator::kernels_by_differences(const at::Tensor& b,
                                                                                const at::Tensor& row_sums) const {
  return kernels_of(b, /*transposed=*/false, row_sums.detach().to(at::kCPU).contiguous());
}

std::shared_ptr<const kernels::Kernels> StencilOperator::kernels_of(const at::Tensor& b, bool transposed,
                                                                    const at::Tensor& row_sums) const {
  const auto offsets = transposed ? negated(offsets_) : offsets_;
  const auto make_batch =
      [transposed, row_sums, offsets, channels = b.size(1), c = coefficients_.detach().to(at::kCPU).contiguous(),
       pattern = std::make_shared<kernels::StencilSparsity>(grid_, offsets)]<class T>(T) -> kernels::KernelBatch<T> {
    kernels::GivenStencil<T> given{c.template const_data_ptr<T>(), c.size(0) == 1 ? 0 : c.stride(0), pattern,
                                   transposed};
    if (row_sums.defined()) {
      const bool is_number = row_sums.dim() == 0;
      const int64_t stride = is_number || row_sums.size(0) == 1 ? 0 : row_sums.stride(0);
      given.row_sums = {row_sums.template const_data_ptr<T>(), stride, is_number, offsets};
    }
    // c and row_sums are captured for their memory, to which `given` points.
    kernels::KernelBatch<T> batch{c.size(0) == 1,
                                  [c, row_sums, given, channels](int64_t s) { return given.make(s, channels); }};
    if (given.is_one_to_one())
      batch.product = [c, given, channels](int64_t s, const T* v, T* out) { given.apply(s, channels, v, out); };
    return batch;
  };
  return kernels::make_kernels(b.scalar_type() == at::kFloat, make_batch);
}

std::optional<gpu::OperatorView> StencilOperator::gpu_view(const at::Tensor& b, bool transposed) const {
  gpu::KernelText type;
  type << "Stencil<" << gpu::type_of(b.scalar_type()) << ", "
       << gpu::grid_of({grid_.shape + zyx(0), static_cast<size_t>(dim())}) << ", " << b.size(1) << ", " << transposed;
  for (const bool periodic : grid_.periodic) type << ", " << periodic;
  for (const auto& offset : offsets_)
    type << ", Offset<" << offset.along[0] << ", " << offset.along[1] << ", " << offset.along[2] << ">";
  type << ">";
  return gpu::OperatorView{type.str(), {coefficients_.contiguous()}};
}

std::optional<kernels::FactorKey> StencilOperator::key(bool transposed) const {
  if (coefficients_.size(0) != 1) return std::nullopt;
  kernels::FactorKeyMaker key;
  key.add(int64_t{transposed});
  for (int64_t d = 0; d < dim(); ++d) key.add(extent(d)).add(int64_t{grid_.periodic[zyx(d)]});
  for (const auto& offset : offsets_) key.add(offset.along, 3);
  return add_numbers(key, coefficients_).key();
}

}  // namespace prdp
