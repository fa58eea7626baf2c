#pragma once
#include <ATen/ATen.h>

#include <cstdint>
#include <vector>

namespace prdp {

/// A uniform grid on the unit interval, square or cube with homogeneous Dirichlet boundaries.
/// `shape` counts the unknowns in tensor order, (N,), (Ny, Nx) or (Nz, Ny, Nx): the x direction is
/// the last axis, boundary points are not unknowns, and neighbours are dx = 1/(N + 1) apart.
class Grid {
 public:
  /// Raises ValueError unless `shape` has 1 to 3 positive extents; `owner` names the caller.
  Grid(const char* owner, std::vector<int64_t> shape);

  const std::vector<int64_t>& shape() const { return shape_; }
  int64_t dim() const { return static_cast<int64_t>(shape_.size()); }
  int64_t unknowns() const;
  double dx(int64_t axis) const { return 1.0 / static_cast<double>(shape_[axis] + 1); }

  /// Raises ValueError unless v has shape (batch, channels, *shape); TypeError unless it is real.
  void check_field(const at::Tensor& v, int64_t channels) const;

 private:
  const char* owner_;
  std::vector<int64_t> shape_;
};

/// Discrete Laplacian L v of a field (batch, channel, *shape) that is zero on the boundary:
/// Σ_d (v_{i-1} - 2 v_i + v_{i+1}) / dx_d². Differentiable.
at::Tensor laplacian(const at::Tensor& v, const Grid& grid);

/// Orthonormal sine basis of one axis: S_jk = √(2/(N+1)) sin(π j k/(N+1)), symmetric, S S = I.
at::Tensor sine_basis(int64_t n, const at::TensorOptions& options);

/// Eigenvalues of L in the sine basis, -Σ_d 4 sin²(π k_d / (2 (N_d + 1))) / dx_d², shape `shape`.
at::Tensor laplacian_eigenvalues(const Grid& grid, const at::TensorOptions& options);

/// Sine transform of the last dim() axes of v; its own inverse.
at::Tensor sine_transform(const at::Tensor& v, const Grid& grid);

}  // namespace prdp
