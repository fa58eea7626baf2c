#include "prdp/grid/grid.h"

#include <ATen/Context.h>

#include <cmath>
#include <numbers>

#include "prdp/error_text.h"

namespace prdp {

const char* hint_of_dtype(at::ScalarType dtype) {
  return at::isReducedFloatingType(dtype) ? "; keep the step in float32, and let autocast take the network to less"
                                          : "";
}

Grid::Grid(const char* owner, std::vector<int64_t> shape, Boundary boundary, std::vector<double> lengths)
    : owner_(owner), shape_(std::move(shape)), boundary_(boundary), lengths_(std::move(lengths)) {
  TORCH_CHECK_VALUE(dim() >= 1 && dim() <= 3, owner_, ": shape must have 1, 2 or 3 extents, got ",
                    at::IntArrayRef(shape_));
  // A point of a periodic axis must not be its own neighbour.
  const int64_t least = boundary_ == Boundary::kPeriodic ? 2 : 1;
  for (const int64_t n : shape_)
    TORCH_CHECK_VALUE(n >= least, owner_, ": every extent of shape must be >= ", least, ", got ",
                      at::IntArrayRef(shape_));
  if (lengths_.empty()) lengths_.assign(shape_.size(), 1.0);
  TORCH_CHECK_VALUE(lengths_.size() == shape_.size(), owner_, ": length must be one number or one per axis, ", dim(),
                    " here, got ", at::ArrayRef<double>(lengths_));
  for (const double length : lengths_)
    TORCH_CHECK_VALUE(std::isfinite(length) && length > 0.0, owner_, ": length must be finite and > 0, got ",
                      at::ArrayRef<double>(lengths_));
}

int64_t Grid::unknowns() const {
  int64_t n = 1;
  for (const int64_t extent : shape_) n *= extent;
  return n;
}

void Grid::check_field(const at::Tensor& v, int64_t channels) const {
  // Symbolic sizes, so that a compiled graph keeps its batch size open.
  const auto sizes = v.sym_sizes();
  bool fits = v.dim() == dim() + 2 && sizes[1] == channels;
  for (int64_t d = 0; fits && d < dim(); ++d) fits = sizes[d + 2] == shape_[d];
  if (!fits) {
    std::ostringstream expected;
    for (const int64_t n : shape_) expected << ", " << n;
    std::ostringstream got;
    for (size_t i = 0; i < sizes.size(); ++i) got << (i ? ", " : "") << sizes[i];
    const bool other_fields = channels == 1 && v.dim() == dim() + 2 && sizes[1] > 1;
    TORCH_CHECK_VALUE(false, owner_, ": expected (batch, ", channels, expected.str(), "), got (", got.str(), ")",
                      other_fields ? "; fields of several channels are samples: u.flatten(0, 1).unsqueeze(1)" : "");
  }
  TORCH_CHECK_TYPE(v.scalar_type() == at::kFloat || v.scalar_type() == at::kDouble, owner_,
                   ": expected float32 or float64, got ", dtype_name(v.scalar_type()), hint_of_dtype(v.scalar_type()));
}

namespace {

/// Where the grid's axis lies in v.
int64_t tensor_axis(const at::Tensor& v, const Grid& grid, int64_t axis) { return v.dim() - grid.dim() + axis; }

/// v_{i + offset} on a periodic grid.
at::Tensor neighbour(const at::Tensor& v, const Grid& grid, int64_t axis, int64_t offset) {
  return at::roll(v, -offset, tensor_axis(v, grid, axis));
}

/// v_{i-1} + v_{i+1}.
at::Tensor neighbour_sum(const at::Tensor& v, const Grid& grid, int64_t axis) {
  if (grid.boundary() == Boundary::kPeriodic) return neighbour(v, grid, axis, -1) + neighbour(v, grid, axis, 1);
  const int64_t d = tensor_axis(v, grid, axis), n = grid.shape()[axis];
  std::vector<int64_t> pad(2 * (v.dim() - d), 0);
  pad[pad.size() - 2] = pad[pad.size() - 1] = 1;
  const auto padded = at::constant_pad_nd(v, pad);
  return padded.narrow(d, 0, n) + padded.narrow(d, 2, n);
}

}  // namespace

at::Tensor laplacian(const at::Tensor& v, const Grid& grid) {
  auto sum = laplacian_diagonal(grid) * v;
  for (int64_t d = 0; d < grid.dim(); ++d) sum = sum + neighbour_sum(v, grid, d) * (1.0 / (grid.dx(d) * grid.dx(d)));
  return sum;
}

double laplacian_diagonal(const Grid& grid) {
  double diagonal = 0.0;
  for (int64_t d = 0; d < grid.dim(); ++d) diagonal -= 2.0 / (grid.dx(d) * grid.dx(d));
  return diagonal;
}

at::Tensor backward_difference(const at::Tensor& v, const Grid& grid, int64_t axis) {
  return (v - neighbour(v, grid, axis, -1)) * (1.0 / grid.dx(axis));
}
at::Tensor forward_difference(const at::Tensor& v, const Grid& grid, int64_t axis) {
  return (neighbour(v, grid, axis, 1) - v) * (1.0 / grid.dx(axis));
}
at::Tensor backward_mean(const at::Tensor& v, const Grid& grid, int64_t axis) {
  return (neighbour(v, grid, axis, -1) + v) * 0.5;
}
at::Tensor forward_mean(const at::Tensor& v, const Grid& grid, int64_t axis) {
  return (v + neighbour(v, grid, axis, 1)) * 0.5;
}

at::Tensor sine_basis(int64_t n, const at::TensorOptions& options) {
  const auto index = at::arange(1, n + 1, options.dtype(at::kDouble));
  const double step = std::numbers::pi / static_cast<double>(n + 1);
  const auto basis = (at::outer(index, index) * step).sin() * std::sqrt(2.0 * step / std::numbers::pi);
  return basis.to(options);
}

at::Tensor laplacian_eigenvalues(const Grid& grid, const at::TensorOptions& options) {
  auto sum = at::zeros(grid.shape(), options.dtype(at::kDouble));
  for (int64_t d = 0; d < grid.dim(); ++d) {
    const int64_t n = grid.shape()[d];
    const auto k = at::arange(1, n + 1, options.dtype(at::kDouble));
    const auto s = (k * (std::numbers::pi / static_cast<double>(2 * (n + 1)))).sin();
    std::vector<int64_t> along(grid.dim(), 1);
    along[d] = n;
    sum = sum - (4.0 / (grid.dx(d) * grid.dx(d)) * s * s).view(along);
  }
  return sum;
}

at::Tensor sine_transform(const at::Tensor& v, const Grid& grid) {
  const at::NoTF32Guard full_precision;
  auto w = v;
  for (int64_t d = 0; d < grid.dim(); ++d) {
    const int64_t axis = tensor_axis(v, grid, d);
    w = at::matmul(w.movedim(axis, -1), sine_basis(grid.shape()[d], v.options())).movedim(-1, axis);
  }
  return w;
}

}  // namespace prdp
