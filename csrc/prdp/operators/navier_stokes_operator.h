#pragma once
#include <optional>

#include "prdp/operators/advection_diffusion.h"
#include "prdp/operators/upwind_operator.h"

namespace prdp {

/// A flow (batch, 3, Ny, Nx) with the mean of its pressure taken off, which the flow does not determine.
/// A cotangent without it passes through an implicit solve, which refuses one with a mean. A velocity alone, of two
/// channels, stays as it is.
at::Tensor without_mean_pressure(const at::Tensor& u);

/// One implicit Euler step of the incompressible Navier-Stokes equations in two dimensions, periodic,
/// linearised about given winds (Oseen), on a staggered grid: u₁ on the left face of a cell, u₂ on its
/// lower face, p in its centre. On vectors (u₁, u₂, p)
///   A = [[C₁, 0, G₁], [0, C₂, G₂], [D₁, D₂, 0]],  C_k = I/Δt + Γ_k - ν L,
/// with divergence D by forward and gradient G = -Dᵀ by backward differences. Γ_k is first-order upwind
/// with the wind at the points of u_k, the other component averaged over its four neighbours there.
/// A and Aᵀ have one null vector, constant pressure.
class NavierStokesOperator final : public UpwindOperator {
 public:
  /// Raises ValueError unless the winds have shape (batch or 1, 2 or 3, Ny, Nx); a third channel, the
  /// pressure, has no influence.
  explicit NavierStokesOperator(const OperatorSpec& spec);

  at::Tensor apply(const at::Tensor& v) const override;
  at::Tensor apply_transpose(const at::Tensor& v) const override;
  at::Tensor diagonal() const override;
  at::Tensor norm() const override;
  at::Tensor norm_of_transpose() const override;
  /// v with its mean pressure taken off.
  at::Tensor project(const at::Tensor& v) const override { return without_mean_pressure(v); }
  /// The solution of least norm to the projected right-hand side.
  at::Tensor solve_directly(const at::Tensor& b, bool transposed) const override;
  std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const override;
  std::unique_ptr<Operator> select(const at::Tensor& index) const override;
  bool has_multigrid_preconditioner() const override { return true; }
  std::shared_ptr<const kernels::Kernels> kernels(const at::Tensor& b, bool transposed) const override;
  std::optional<gpu::OperatorView> gpu_view(const at::Tensor& b, bool transposed) const override;

 private:
  /// C₁ and C₂, made when first wanted: the CPU loops never ask for them.
  struct Momentum {
    AdvectionDiffusion along_x, along_y;
  };
  const Momentum& momentum() const;
  /// (C₁u₁ + s G₁p, C₂u₂ + s G₂p, s (D₁u₁ + D₂u₂)) out of C₁u₁, C₂u₂ and v = (u₁, u₂, p).
  at::Tensor couple(const at::Tensor& c1_u1, const at::Tensor& c2_u2, double s, const at::Tensor& v) const;
  /// The norm of A, or of Aᵀ, from the sums of magnitudes in the rows of C₁ and C₂, or in their columns.
  at::Tensor norm_of(const at::Tensor& of_c1, const at::Tensor& of_c2) const;
  /// A plus the mean of the pressure in each of its rows, (batch or 1, n, n).
  at::Tensor regular_matrix() const;

  mutable std::optional<Momentum> made_;
};

}  // namespace prdp
