#pragma once
#include <memory>
#include <optional>

#include "prdp/autograd/linear_solve.h"
#include "prdp/steppers/rollout.h"

namespace prdp {

/// One time step (or one elliptic solve) as a function u → u_next on (batch, channel, *shape) in
/// float32 or float64; differentiable as options().backward says. Copies share their reports.
class Stepper {
 public:
  /// Raises ValueError for bad shapes, parameters or budgets, before any work.
  Stepper(Equation equation, SolveOptions options);

  at::Tensor operator()(const at::Tensor& u);
  /// The states of `steps` steps, u included: (batch, steps + 1, channel, *shape); info() and
  /// adjoint_info() then hold tensors (batch, steps). One node of autograd (rollout.h).
  at::Tensor rollout(const at::Tensor& u, int64_t steps);

  OperatorSpec operator_at(const at::Tensor& u) const { return equation_operator(equation_, u); }
  at::Tensor rhs(const at::Tensor& u) const { return equation_rhs(equation_, u); }

  /// K, the budget of the primal solve, and of the adjoint one unless it has its own.
  int64_t max_iter() const { return options_.solver.max_iter.expect_int(); }
  void set_max_iter(int64_t k);
  SolveOptions& options() { return options_; }

  /// Of the last step; nothing before the first.
  const std::optional<SolveInfo>& info() const { return info_; }
  /// Of the last adjoint solve; nothing before the first backward pass in implicit mode.
  std::optional<SolveInfo> adjoint_info() const;
  /// Whether every sample of the last step, and of its adjoint solve where there was one, met rtol.
  bool converged() const;

 private:
  Equation equation_;
  SolveOptions options_;
  std::optional<SolveInfo> info_;
  std::shared_ptr<const int64_t> adjoint_log_;
};

/// Δu = -p on `shape` unknowns of the unit domain, u = 0 on its boundary: p → u.
class Poisson : public Stepper {
 public:
  Poisson(std::vector<int64_t> shape, Solver solver, Backward backward = Backward::kImplicit);
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
       Backward backward = Backward::kImplicit);
};

/// One implicit Euler step of u_t + (u·∇)u = ν Δu on a periodic grid, shape (N) or (Ny, Nx); u has one
/// channel an axis, channel 0 along x, the last axis. First-order upwind, linearised about the state,
/// or with picard_steps > 1 about the solution of the solve before.
class Burgers : public Stepper {
 public:
  Burgers(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver,
          Backward backward = Backward::kImplicit, int64_t picard_steps = 1);
};

/// One implicit Euler step of u_t + (u·∇)u + ∇p = ν Δu, ∇·u = 0 on a periodic grid (Ny, Nx). The state
/// is (batch, 3, Ny, Nx) = (u₁, u₂, p), staggered: u₁ on the left face of a cell, u₂ on its lower face,
/// p of mean zero in its centre. Linearised as Burgers.
class NavierStokes : public Stepper {
 public:
  NavierStokes(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver,
               Backward backward = Backward::kImplicit, int64_t picard_steps = 1);
};

}  // namespace prdp
