#pragma once
#include <optional>

#include "prdp/operators/advection_diffusion.h"
#include "prdp/operators/upwind_operator.h"

namespace prdp {

/// One implicit Euler step of Burgers' equation in one or two dimensions, periodic, linearised about
/// the winds: A = I + Δt (Γ - ν L) on each of the dim() velocity channels. Γ is first-order upwind with
/// the winds averaged to the faces of a cell, (w_{i-1} + w_i)/2 and (w_i + w_{i+1})/2. Row sums are 1
/// and off-diagonal entries <= 0.
class BurgersOperator final : public UpwindOperator {
 public:
  /// Raises ValueError unless the winds have shape (batch or 1, dim, *shape) with dim <= 2.
  explicit BurgersOperator(const OperatorSpec& spec);

  at::Tensor apply(const at::Tensor& v) const override { return block().apply(v); }
  at::Tensor apply_transpose(const at::Tensor& v) const override { return block().apply_transpose(v); }
  at::Tensor diagonal() const override { return block().diagonal(); }
  at::Tensor norm() const override { return largest(block().row_norms()); }
  at::Tensor norm_of_transpose() const override { return largest(block().column_norms()); }
  at::Tensor solve_directly(const at::Tensor& b, bool transposed) const override;
  std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const override;
  std::unique_ptr<Operator> select(const at::Tensor& index) const override;
  bool has_coarse_grids() const override { return true; }
  std::shared_ptr<const kernels::Kernels> kernels(const at::Tensor& b, bool transposed) const override;
  std::optional<gpu::OperatorView> gpu_view(const at::Tensor& b, bool transposed) const override;

 private:
  /// The block of one channel, made when first wanted: the CPU loops never ask for it.
  const AdvectionDiffusion& block() const;
  /// The same operator as a stencil, for vectors like b.
  OperatorSpec as_stencil(const at::Tensor& b) const;

  mutable std::optional<AdvectionDiffusion> made_;
};

}  // namespace prdp
