#include "prdp/grid/grid.h"

#include <numbers>

namespace prdp {

Grid::Grid(const char* owner, std::vector<int64_t> shape)
    : owner_(owner), shape_(std::move(shape)) {
  TORCH_CHECK_VALUE(dim() >= 1 && dim() <= 3, owner_, ": shape must have 1, 2 or 3 extents, got ",
                    at::IntArrayRef(shape_));
  for (const int64_t n : shape_)
    TORCH_CHECK_VALUE(n >= 1, owner_, ": every extent of shape must be >= 1, got ",
                      at::IntArrayRef(shape_));
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
    TORCH_CHECK_VALUE(false, owner_, ": expected (batch, ", channels, expected.str(), "), got (",
                      got.str(), ")");
  }
  TORCH_CHECK_TYPE(v.scalar_type() == at::kFloat || v.scalar_type() == at::kDouble, owner_,
                   ": expected float32 or float64, got ", v.scalar_type());
}

namespace {

/// v_{i-1} + v_{i+1} along `axis` of extent n, zero outside.
at::Tensor neighbour_sum(const at::Tensor& v, int64_t axis, int64_t n) {
  std::vector<int64_t> pad(2 * (v.dim() - axis), 0);
  pad[pad.size() - 2] = pad[pad.size() - 1] = 1;
  const auto padded = at::constant_pad_nd(v, pad);
  return padded.narrow(axis, 0, n) + padded.narrow(axis, 2, n);
}

}  // namespace

at::Tensor laplacian(const at::Tensor& v, const Grid& grid) {
  at::Tensor sum;
  double centre = 0.0;
  for (int64_t d = 0; d < grid.dim(); ++d) {
    const double weight = 1.0 / (grid.dx(d) * grid.dx(d));
    const auto term = neighbour_sum(v, v.dim() - grid.dim() + d, grid.shape()[d]) * weight;
    sum = sum.defined() ? sum + term : term;
    centre -= 2.0 * weight;
  }
  return sum + centre * v;
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
  auto w = v;
  for (int64_t d = 0; d < grid.dim(); ++d) {
    const int64_t axis = v.dim() - grid.dim() + d;
    w = at::matmul(w.movedim(axis, -1), sine_basis(grid.shape()[d], v.options())).movedim(-1, axis);
  }
  return w;
}

}  // namespace prdp
