#pragma once
#include <optional>
#include <vector>

#include "prdp/kernels/factor_cache.h"
#include "prdp/operators/separable_inverse.h"

namespace prdp {

/// Whether stencils are sums of operators along the axes (separable), decided on the host from one copy: of the
/// coefficients on the line through the middle point along each axis, of whether A is diagonal on the planes at the
/// ends of the axes, and of the largest distance, on the other, inner points, between A and the sum that the lines
/// give.
class Separability {
 public:
  /// `coefficients`: (batch or 1, 1 + 2 dim, *shape) as StencilOperator::nearest_coefficients() orders them, with at
  /// least 3 points along each axis.
  Separability(const at::Tensor& coefficients, const std::vector<bool>& periodic);

  int64_t samples() const { return host_.size(0); }
  bool is_finite(int64_t s) const;
  /// The sum on the inner points; nothing if A is none, or not symmetric.
  std::optional<kernels::SumOverAxes> sum(int64_t s) const;
  InnerBox inner_box(int64_t s) const;
  kernels::FactorKey key(int64_t s, int64_t null_vectors, const at::TensorOptions& options) const;
  double epsilon() const { return epsilon_; }

 private:
  int64_t dim() const { return static_cast<int64_t>(shape_.size()); }
  int64_t middle(int64_t axis) const { return shape_[axis] / 2; }
  /// (batch or 1, k, n)
  at::Tensor middle_line(const at::Tensor& coefficients, int64_t axis) const;
  /// Whether nothing couples the points of the first, and of the last plane to any others: (batch or 1, 2).
  at::Tensor decoupled_ends(const at::Tensor& coefficients, int64_t axis) const;
  /// Where the points of the decoupled ends are, for which A is diagonal: bool, broadcast over the grid; undefined if
  /// all axes are periodic.
  at::Tensor decoupled_planes(const std::vector<at::Tensor>& ends) const;
  /// As Sizes has them, (batch or 1, 1) each. The inner points are those that `outer` does not mark.
  std::vector<at::Tensor> largest_sizes(const at::Tensor& coefficients, const std::vector<at::Tensor>& lines,
                                        const at::Tensor& outer) const;
  /// The largest of all coefficients of a point.
  at::Tensor distance_from_sum(const at::Tensor& coefficients, const std::vector<at::Tensor>& lines) const;
  /// The columns of `host_`, in their order: lines, ends, sizes.
  void take_apart(const std::vector<at::Tensor>& lines);
  kernels::SumOverAxes sum_of_lines(int64_t s, const InnerBox& box) const;

  struct Sizes {
    double distance, norm, diagonal, inverse_diagonal;  // the largest ones of the inner points
    double largest;                                     // of all coefficients
  };
  Sizes sizes(int64_t s) const;

  std::vector<int64_t> shape_;
  std::vector<bool> periodic_;
  double epsilon_;
  // On the host, in float64: (samples, columns), and what its columns are.
  at::Tensor host_;
  std::vector<at::Tensor> lines_;  // of each axis (samples, 1 + 2 dim, n)
  std::vector<at::Tensor> ends_;   // of each axis (samples, 2), not 0 where they are decoupled
  at::Tensor sizes_;               // (samples, 5), as Sizes has them
};

}  // namespace prdp
