#pragma once
#include <vector>

#include "prdp/steppers/rollout.h"
#include "prdp/steppers/stepper.h"

namespace prdp {

/// One time step, or one elliptic solve, as a function u → u_next. States are (batch, channel, *shape) in float32 or
/// float64. options().backward chooses how gradients are computed.
class Stepper : public StepperBase {
 public:
  /// Raises ValueError for bad shapes, parameters or budgets, before any work. So does a step for a bad u.
  Stepper(Equation equation, SolveOptions options);

  at::Tensor operator()(const at::Tensor& u);
  /// Repeats the step. Returns all states, u included: (batch, steps + 1, channel, *shape). info() and adjoint_info()
  /// then hold tensors (batch, steps). One node of autograd (rollout.h).
  at::Tensor rollout(const at::Tensor& u, int64_t steps);

  OperatorSpec operator_at(const at::Tensor& u) const { return equation_operator(equation_, u); }
  at::Tensor rhs(const at::Tensor& u) const { return equation_rhs(equation_, u); }

 private:
  Equation equation_;
};

/// The sides of the domain, > 0: one number for all axes, or one per axis in the order of `shape`.
struct Length {
  Length(double all) : sides{all} {}
  Length(std::vector<double> of_axes) : sides(std::move(of_axes)) {}
  Length(std::initializer_list<double> of_axes) : sides(of_axes) {}
  std::vector<double> sides;
};

/// Maps p to the solution u of Δu = -p, with u = 0 on the boundary (paper, appendix C.1); both (batch, 1, *shape). Its
/// operator is Δ, its right-hand side -p.
class Poisson : public Stepper {
 public:
  Poisson(std::vector<int64_t> shape, Solver solver, Backward backward = Backward::kImplicit, Length length = 1.0);
};

/// nu >= 0 in length²/time: a number, or a tensor, which gets a gradient: 0-dimensional, or (batch,), one for each
/// sample, in the dtype of the states.
struct Viscosity {
  Viscosity(double nu);
  Viscosity(at::Tensor nu) : tensor(std::move(nu)) {}
  at::Tensor tensor;
};

/// One implicit Euler step of u_t = ν Δu with u = 0 on the boundary; dt > 0 (paper, appendix C.2 to C.4).
class Heat : public Stepper {
 public:
  Heat(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver, Backward backward = Backward::kImplicit,
       Length length = 1.0);
};

/// One implicit Euler step of u_t + (u·∇)u = ν Δu on a periodic grid of shape (N) or (Ny, Nx) (paper, appendix C.5). u
/// has one channel per axis; channel 0 is the velocity along x, the last axis. Advection is first-order upwind,
/// linearised about the state. A step makes picard_steps solves, each linearised about the solution of the one before.
class Burgers : public Stepper {
 public:
  Burgers(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver, Backward backward = Backward::kImplicit,
          int64_t picard_steps = 1, Length length = 1.0);
};

/// One implicit Euler step of u_t + (u·∇)u + ∇p = ν Δu, ∇·u = 0 on a periodic grid (Ny, Nx) (paper, appendix C.6). The
/// state (batch, 3, Ny, Nx) holds u₁ on the left face of each cell, u₂ on its lower face, and the pressure p of mean
/// zero in its centre. Linearised as Burgers.
class NavierStokes : public Stepper {
 public:
  NavierStokes(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver,
               Backward backward = Backward::kImplicit, int64_t picard_steps = 1, Length length = 1.0);
};

}  // namespace prdp
