#include <algorithm>
#include <cmath>
#include <sstream>

#include "prdp/error_text.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/operators/tensors.h"

/// What a Stencil is made of, and what of it is refused.
namespace prdp {

namespace {

constexpr int64_t kFarthest = 2;

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
                      " cells along each axis, got ", as_tuple(entries(offset, dim)), "; Matrix.csr takes any");
  return offset;
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
                   "Stencil: coefficients must be float32 or float64, got ", dtype_name(coefficients_.scalar_type()));
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
  check_goes_with(coefficients_, b, "Stencil", "the coefficients");
}

}  // namespace prdp
