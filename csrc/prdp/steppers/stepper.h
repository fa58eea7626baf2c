#pragma once
#include <vector>

#include "prdp/steppers/rollout.h"
#include "prdp/steppers/solving.h"

namespace prdp {

/// One time step (or one elliptic solve) as a function u → u_next on (batch, channel, *shape) in
/// float32 or float64; differentiable as options().backward says.
class Stepper : public Solving {
 public:
  /// Raises ValueError for bad shapes, parameters or budgets, before any work.
  Stepper(Equation equation, SolveOptions options);

  at::Tensor operator()(const at::Tensor& u);
  /// The states of `steps` steps, u included: (batch, steps + 1, channel, *shape); info() and
  /// adjoint_info() then hold tensors (batch, steps). One node of autograd (rollout.h).
  at::Tensor rollout(const at::Tensor& u, int64_t steps);

  OperatorSpec operator_at(const at::Tensor& u) const { return equation_operator(equation_, u); }
  at::Tensor rhs(const at::Tensor& u) const { return equation_rhs(equation_, u); }

 private:
  Equation equation_;
};

/// Sides of the domain: one number for all axes, or one number per axis in the order of `shape`.
struct Length {
  Length(double all) : sides{all} {}
  Length(std::vector<double> of_axes) : sides(std::move(of_axes)) {}
  Length(std::initializer_list<double> of_axes) : sides(of_axes) {}
  std::vector<double> sides;
};

/// Δu = -p on `shape` unknowns, u = 0 on the boundary of the domain: p → u.
class Poisson : public Stepper {
 public:
  Poisson(std::vector<int64_t> shape, Solver solver, Backward backward = Backward::kImplicit,
          Length length = 1.0);
};

/// nu >= 0 (length²/time), a number or a 0-dimensional tensor, which then gets a gradient.
struct Viscosity {
  Viscosity(double nu) : tensor(at::scalar_tensor(nu, at::kDouble)) {}
  Viscosity(at::Tensor nu) : tensor(std::move(nu)) {}
  at::Tensor tensor;
};

/// One implicit Euler step of u_t = ν Δu, u = 0 on the boundary; dt > 0.
class Heat : public Stepper {
 public:
  Heat(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver,
       Backward backward = Backward::kImplicit, Length length = 1.0);
};

/// One implicit Euler step of u_t + (u·∇)u = ν Δu on a periodic grid, shape (N) or (Ny, Nx); u has one
/// channel an axis, channel 0 along x, the last axis. First-order upwind, linearised about the state,
/// or with picard_steps > 1 about the solution of the solve before.
class Burgers : public Stepper {
 public:
  Burgers(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver,
          Backward backward = Backward::kImplicit, int64_t picard_steps = 1, Length length = 1.0);
};

/// One implicit Euler step of u_t + (u·∇)u + ∇p = ν Δu, ∇·u = 0 on a periodic grid (Ny, Nx). The state
/// is (batch, 3, Ny, Nx) = (u₁, u₂, p), staggered: u₁ on the left face of a cell, u₂ on its lower face,
/// p of mean zero in its centre. Linearised as Burgers.
class NavierStokes : public Stepper {
 public:
  NavierStokes(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver,
               Backward backward = Backward::kImplicit, int64_t picard_steps = 1, Length length = 1.0);
};

}  // namespace prdp
