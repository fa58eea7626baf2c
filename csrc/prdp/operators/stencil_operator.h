#pragma once
#include "prdp/grid/grid.h"
#include "prdp/kernels/stencil_sparsity.h"
#include "prdp/operators/operator.h"

namespace prdp {

/// An operator for linear_solve: (A v)[i] = Σ_k coefficients[k, i] · v[i + offsets[k]] on a grid of one to three axes,
/// the same for every channel of v (batch, channel, *shape).
///
/// coefficients: (batch or 1, k, *shape), float32 or float64; they get gradients. offsets: k distinct ones, each with
/// one entry per axis, at most two cells. boundary: v is zero outside the grid (Boundary::kDirichlet) or periodic; one
/// for all axes, or one per axis. Raises ValueError if these do not fit together.
OperatorSpec stencil(const at::Tensor& coefficients, const std::vector<std::vector<int64_t>>& offsets,
                     const std::vector<Boundary>& boundary = {Boundary::kDirichlet});

/// The same from coefficients (batch or 1, 1 + 2 dim, *shape) of the point itself and of those before and behind it
/// along each axis, in this order.
OperatorSpec nearest_stencil(const at::Tensor& coefficients, const std::vector<int64_t>& shape,
                             const std::vector<bool>& periodic);

/// The operator of kind "stencil". Parameters: for each axis whether it is periodic, then the offsets one after the
/// other. Tensors: the coefficients.
class StencilOperator final : public Operator {
 public:
  explicit StencilOperator(const OperatorSpec& spec);

  void check_vector(const at::Tensor& b) const override;
  at::Tensor apply(const at::Tensor& v) const override;
  at::Tensor apply_transpose(const at::Tensor& v) const override;
  at::Tensor diagonal() const override;
  at::Tensor norm() const override;
  at::Tensor norm_of_transpose() const override;
  at::Tensor solve_directly(const at::Tensor& b, bool transposed) const override;
  std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const override;
  std::vector<int64_t> first_nonfinite(int64_t sample) const override;
  std::unique_ptr<Operator> select(const at::Tensor& index) const override;
  std::vector<int64_t> vector_shape() const override;
  bool has_coarse_grids() const override;
  bool may_be_singular() const override { return true; }
  std::shared_ptr<const kernels::Kernels> kernels(const at::Tensor& b, bool transposed) const override;
  std::optional<gpu::OperatorView> gpu_view(const at::Tensor& b, bool transposed) const override;
  std::optional<kernels::FactorKey> key(bool transposed) const override;

  /// Kernels of products with row_sum_i v_i + Σ_k a_k (v_k - v_i), over nearest neighbours k. row_sums: the diagonal
  /// plus all coefficients of a point, also those that lead to a zero beyond the grid; 0-dimensional or (batch or 1, 1,
  /// *shape). The coefficients hold as many samples.
  std::shared_ptr<const kernels::Kernels> kernels_by_differences(const at::Tensor& b, const at::Tensor& row_sums) const;
  OperatorSpec spec() const;
  /// Of A, or of Aᵀ, the diagonal and what couples a point to those before and behind it along each axis, (batch or 1,
  /// 1 + 2 dim, *shape), zero where there is none; undefined if A couples points that are no neighbours.
  at::Tensor nearest_coefficients(bool transposed) const;

 private:
  std::shared_ptr<const kernels::Kernels> kernels_of(const at::Tensor& b, bool transposed,
                                                     const at::Tensor& row_sums) const;
  at::Tensor norm_of(bool transposed) const;
  int64_t dim() const { return grid_.dim; }
  int64_t count() const { return static_cast<int64_t>(offsets_.size()); }
  /// The index of an axis among (z, y, x): the last dim() of them are this operator's.
  int64_t zyx(int64_t axis) const { return 3 - dim() + axis; }
  int64_t extent(int64_t axis) const { return grid_.shape[zyx(axis)]; }
  /// Coefficient k, (batch or 1, 1, *shape).
  at::Tensor coefficient(int64_t k) const { return coefficients_.narrow(1, k, 1); }
  /// t[i + offset], with `back` t[i - offset], along the last dim() axes of t: zero or periodic beyond the ends.
  at::Tensor shifted(const at::Tensor& t, const kernels::Offset& offset, bool back = false) const;

  kernels::StencilGrid grid_;
  std::vector<kernels::Offset> offsets_;
  at::Tensor coefficients_;
};

}  // namespace prdp
