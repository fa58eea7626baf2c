#include "prdp/operators/stencil_operator.h"

#include <algorithm>
#include <cmath>
#include <sstream>

#include "prdp/gpu/operator_view.h"
#include "prdp/kernels/given_stencil.h"
#include "prdp/kernels/kernel.h"
#include "prdp/operators/stencil_direct.h"
#include "prdp/operators/tensor_factor_key.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

constexpr int64_t kFarthest = 2;
constexpr int64_t kItself = 0;  // the place of the point itself in StencilSparsity::offsets

/// "(0, -1)", or "(3,)" for one number.
std::string as_tuple(at::ArrayRef<int64_t> values) {
  std::ostringstream text;
  for (size_t i = 0; i < values.size(); ++i) text << (i ? ", " : "(") << values[i];
  text << (values.size() == 1 ? ",)" : ")");
  return text.str();
}

at::ArrayRef<int64_t> entries(const kernels::Offset& offset, int64_t dim) {
  return {offset.along + 3 - dim, static_cast<size_t>(dim)};
}

/// An offset out of one number per axis. Raises ValueError unless these are whole and at most kFarthest.
kernels::Offset offset_of(at::ArrayRef<double> cells) {
  const auto dim = static_cast<int64_t>(cells.size());
  kernels::Offset offset{{0, 0, 0}};
  for (int64_t d = 0; d < dim; ++d) {
    constexpr double exact = 1LL << 53;  // up to here a double holds every whole number
    TORCH_CHECK_VALUE(std::abs(cells[d]) <= exact && cells[d] == std::trunc(cells[d]),
                      "Stencil: every entry of an offset must be a whole number, got ", cells[d]);
    offset.along[3 - dim + d] = static_cast<int64_t>(cells[d]);
  }
  for (const int64_t along : offset.along)
    TORCH_CHECK_VALUE(std::abs(along) <= kFarthest, "Stencil: offsets reach at most ", kFarthest,
                      " cells along each axis, got ", as_tuple(entries(offset, dim)));
  return offset;
}

/// The neighbours on the other side, which are those of the transpose.
std::vector<kernels::Offset> negated(std::vector<kernels::Offset> offsets) {
  for (auto& offset : offsets)
    for (auto& cells : offset.along) cells = -cells;
  return offsets;
}

}  // namespace

OperatorSpec stencil(const at::Tensor& coefficients, const std::vector<std::vector<int64_t>>& offsets,
                     const std::vector<Boundary>& boundary) {
  TORCH_CHECK_VALUE(coefficients.dim() >= 3 && coefficients.dim() <= 5,
                    "Stencil: coefficients must have shape (batch or 1, k, *shape) with 1 to 3 axes in shape, got ",
                    coefficients.sizes());
  const auto dim = static_cast<size_t>(coefficients.dim() - 2);
  TORCH_CHECK_VALUE(boundary.size() == 1 || boundary.size() == dim, "Stencil: boundary must be one for all axes or ",
                    dim, ", one for each, got ", boundary.size());
  OperatorSpec spec{"stencil", coefficients.sizes().slice(2).vec(), {}, {coefficients}};
  for (size_t d = 0; d < dim; ++d)
    spec.parameters.push_back(boundary[boundary.size() == 1 ? 0 : d] == Boundary::kPeriodic);
  for (const auto& offset : offsets) {
    TORCH_CHECK_VALUE(offset.size() == dim, "Stencil: every offset must have ", dim,
                      " entries, one for each axis of shape, got ", as_tuple(offset));
    spec.parameters.insert(spec.parameters.end(), offset.begin(), offset.end());
  }
  [[maybe_unused]] const StencilOperator checks_the_rest(spec);
  return spec;
}

OperatorSpec nearest_stencil(const at::Tensor& coefficients, const std::vector<int64_t>& shape,
                             const std::vector<bool>& periodic) {
  OperatorSpec spec{"stencil", shape, {}, {coefficients}};
  spec.parameters.assign(periodic.begin(), periodic.end());
  const auto dim = periodic.size();
  spec.parameters.insert(spec.parameters.end(), dim, 0.0);
  for (size_t axis = 0; axis < dim; ++axis)
    for (const double cells : {-1.0, 1.0})
      for (size_t d = 0; d < dim; ++d) spec.parameters.push_back(d == axis ? cells : 0.0);
  return spec;
}

StencilOperator::StencilOperator(const OperatorSpec& spec) : grid_{0, {1, 1, 1}, {false, false, false}} {
  TORCH_CHECK_VALUE(spec.tensors.size() == 1, "Stencil: takes one tensor, the coefficients");
  coefficients_ = spec.tensors[0];
  grid_.dim = static_cast<int64_t>(spec.shape.size());
  const auto sizes = coefficients_.sym_sizes();
  TORCH_CHECK_VALUE(dim() >= 1 && dim() <= 3 && coefficients_.dim() == dim() + 2,
                    "Stencil: coefficients must have shape (batch or 1, k, *shape) with 1 to 3 axes in shape, got ",
                    sizes);
  TORCH_CHECK_TYPE(coefficients_.scalar_type() == at::kFloat || coefficients_.scalar_type() == at::kDouble,
                   "Stencil: coefficients must be float32 or float64, got ", coefficients_.scalar_type());
  const at::ArrayRef<double> p = spec.parameters;
  const auto axes = static_cast<size_t>(dim());
  TORCH_CHECK_VALUE(p.size() >= axes && p.size() % axes == 0, "Stencil: every offset must have ", dim(), " entries");
  for (int64_t d = 0; d < dim(); ++d) {
    TORCH_CHECK_VALUE(spec.shape[d] >= 1 && sizes[d + 2] == spec.shape[d],
                      "Stencil: coefficients must have shape (batch or 1, k, ", at::IntArrayRef(spec.shape),
                      ") with every extent >= 1, got ", sizes);
    grid_.shape[zyx(d)] = spec.shape[d];
    grid_.periodic[zyx(d)] = p[d] != 0.0;
  }
  for (size_t start = axes; start < p.size(); start += axes) {
    const auto offset = offset_of(p.slice(start, axes));
    TORCH_CHECK_VALUE(std::find(offsets_.begin(), offsets_.end(), offset) == offsets_.end(), "Stencil: the offset ",
                      as_tuple(entries(offset, dim())), " is there twice; add up its coefficients");
    offsets_.push_back(offset);
  }
  TORCH_CHECK_VALUE(!offsets_.empty(), "Stencil: there must be at least one offset");
  TORCH_CHECK_VALUE(sizes[1] == count(), "Stencil: ", count(), " offsets need coefficients of shape (batch or 1, ",
                    count(), ", *shape), got ", sizes);
}

void StencilOperator::check_vector(const at::Tensor& b) const {
  const auto sizes = b.sym_sizes();
  bool fits = b.dim() == dim() + 2;
  for (int64_t d = 0; fits && d < dim(); ++d) fits = sizes[d + 2] == extent(d);
  if (!fits) {
    std::ostringstream expected;
    for (int64_t d = 0; d < dim(); ++d) expected << ", " << extent(d);
    TORCH_CHECK_VALUE(false, "Stencil: expected (batch, channel", expected.str(), "), got ", sizes);
  }
  TORCH_CHECK_VALUE(sizes[1] != 0, "Stencil: a vector must have at least one channel, got ", sizes);
  TORCH_CHECK_VALUE(coefficients_.sym_size(0) == 1 || coefficients_.sym_size(0) == sizes[0],
                    "Stencil: the coefficients hold ", coefficients_.sym_size(0), " samples, the vector holds ",
                    sizes[0]);
  TORCH_CHECK_TYPE(b.scalar_type() == coefficients_.scalar_type(), "Stencil: the coefficients are ",
                   coefficients_.scalar_type(), " but the vector is ", b.scalar_type());
  TORCH_CHECK_VALUE(b.device() == coefficients_.device(), "Stencil: the coefficients are on ", coefficients_.device(),
                    " but the vector is on ", b.device());
}

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

at::Tensor StencilOperator::norm() const {
  const kernels::StencilSparsity pattern(grid_, offsets_);
  const auto inside = at::ones(coefficients_.sizes().slice(2), coefficients_.options());
  std::vector<at::Tensor> entries(pattern.offsets.size());
  auto rows = coefficients_.mul(0).sum(1);  // NaN where a coefficient is not finite
  for (int64_t k = 0; k < count(); ++k)
    if (const int64_t place = pattern.places[k]; place >= 0)
      add_to(entries[place], coefficient(k).squeeze(1) * shifted(inside, offsets_[k]));
  for (const auto& entry : entries)
    if (entry.defined()) rows = rows + entry.abs();
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
    for (const int64_t cells : entries(offset, dim())) spec.parameters.push_back(static_cast<double>(cells));
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
  std::ostringstream type;
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
