#pragma once
#include <ATen/ATen.h>

#include <cstdint>
#include <vector>

namespace prdp {

/// The values beyond the ends of every axis.
enum class Boundary {
  kDirichlet,  // zero; boundary points are not unknowns, dx = length/(N + 1)
  kPeriodic,   // those from the other end; dx = length/N
};

/// What errors about the dtype of a state add for one of less than float32: the remedy.
const char* hint_of_dtype(at::ScalarType dtype);

/// A uniform grid on an interval, a rectangle or a box. `shape` counts the unknowns in tensor order, (N,), (Ny, Nx) or
/// (Nz, Ny, Nx): the x direction is the last axis. `lengths` are the sides of the domain in the same order; without
/// them all sides are 1. Functions of a field and a grid take the last dim() axes of the tensor for the grid, and count
/// its axes as `shape` does.
class Grid {
 public:
  /// Raises ValueError, in the name of `owner`, unless `shape` has 1 to 3 extents >= 1 (>= 2 if the grid is periodic),
  /// and `lengths` is empty or has a finite number > 0 per axis.
  Grid(const char* owner, std::vector<int64_t> shape, Boundary boundary = Boundary::kDirichlet,
       std::vector<double> lengths = {});

  const std::vector<int64_t>& shape() const { return shape_; }
  int64_t dim() const { return static_cast<int64_t>(shape_.size()); }
  int64_t unknowns() const;
  Boundary boundary() const { return boundary_; }
  double length(int64_t axis) const { return lengths_[axis]; }
  double dx(int64_t axis) const {
    return lengths_[axis] / static_cast<double>(shape_[axis] + (boundary_ == Boundary::kDirichlet));
  }

  /// Raises ValueError unless v has shape (batch, channels, *shape); TypeError unless it is real.
  void check_field(const at::Tensor& v, int64_t channels) const;

 private:
  const char* owner_;
  std::vector<int64_t> shape_;
  Boundary boundary_;
  std::vector<double> lengths_;
};

/// The discrete Laplacian L v = Σ_d (v_{i-1} - 2 v_i + v_{i+1}) / dx_d². Differentiable.
at::Tensor laplacian(const at::Tensor& v, const Grid& grid);
/// The diagonal of L: -Σ_d 2 / dx_d².
double laplacian_diagonal(const Grid& grid);

/// One-sided differences on a periodic grid, (v_i - v_{i-1})/dx and (v_{i+1} - v_i)/dx: each is minus
/// the transpose of the other.
at::Tensor backward_difference(const at::Tensor& v, const Grid& grid, int64_t axis);
at::Tensor forward_difference(const at::Tensor& v, const Grid& grid, int64_t axis);
/// Means of neighbours on a periodic grid, (v_{i-1} + v_i)/2 and (v_i + v_{i+1})/2: each is the
/// transpose of the other.
at::Tensor backward_mean(const at::Tensor& v, const Grid& grid, int64_t axis);
at::Tensor forward_mean(const at::Tensor& v, const Grid& grid, int64_t axis);

/// The orthonormal sine basis of one axis, (n, n): S_jk = √(2/(N+1)) sin(π j k/(N+1)), symmetric, S S = I.
at::Tensor sine_basis(int64_t n, const at::TensorOptions& options);

/// The eigenvalues of L in the sine basis, -Σ_d 4 sin²(π k_d / (2 (N_d + 1))) / dx_d², as a tensor of the grid's shape.
at::Tensor laplacian_eigenvalues(const Grid& grid, const at::TensorOptions& options);

/// The sine transform of the last dim() axes of v. It is its own inverse.
at::Tensor sine_transform(const at::Tensor& v, const Grid& grid);

}  // namespace prdp
