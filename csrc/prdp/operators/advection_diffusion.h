#pragma once
#include "prdp/grid/grid.h"

namespace prdp {

/// Winds along one axis of the grid, each (batch or 1, 1, *shape): at the lower and at the upper face of
/// a cell; equal where the wind is taken at the point itself.
struct AxisWinds {
  at::Tensor lower, upper;
};

/// C = α I + β (Γ - ν L) on a periodic grid, the same for every channel, with first-order upwind
/// advection Γ v = Σ_d max(lower_d, 0) B_d v + min(upper_d, 0) F_d v; B and F are the backward and the
/// forward difference. The derivative of max(w, 0) and min(w, 0) at w = 0 is 1/2. Differentiable.
class AdvectionDiffusion {
 public:
  /// `winds` in the order of the grid's axes; nu beside (batch, channel, *shape).
  AdvectionDiffusion(const Grid& grid, std::vector<AxisWinds> winds, at::Tensor nu, double alpha, double beta);

  at::Tensor apply(const at::Tensor& v) const;
  at::Tensor apply_transpose(const at::Tensor& v) const;
  /// (batch or 1, 1, *shape).
  at::Tensor diagonal() const;
  /// (batch or 1, 1 + 2 dim, *shape): the diagonal, and for each axis what couples a point to those before and after.
  at::Tensor coefficients() const;
  /// Σ_j |C_ij|, as the diagonal.
  at::Tensor row_norms() const { return 2.0 * diagonal() - alpha_; }
  /// Σ_i |C_ij|, in the same way: only the diagonal is positive.
  at::Tensor column_norms() const;

  /// ∂⟨λ, C u⟩ with respect to the winds and nu; λ and u (batch, channel, *shape), the winds' batch
  /// that of u.
  struct Gradients {
    std::vector<AxisWinds> winds;
    at::Tensor nu_terms;  // like u, whose sum is the derivative
  };
  Gradients product_rule(const at::Tensor& lambda, const at::Tensor& u) const;

 private:
  Grid grid_;
  std::vector<AxisWinds> winds_;
  std::vector<AxisWinds> inflow_;  // max(lower, 0), min(upper, 0)
  at::Tensor nu_;
  double alpha_, beta_;
};

}  // namespace prdp
