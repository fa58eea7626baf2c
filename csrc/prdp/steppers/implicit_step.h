#pragma once
#include <functional>

#include "prdp/autograd/linear_solve.h"
#include "prdp/steppers/stepper.h"

namespace prdp {

/// A step of your own equation: it solves A(u) u_next = b(u) for any operator and does all that the built-in steppers
/// do. The state u has the shape of the operator's vectors, (batch, …). Gradients reach u and all tensors that A(u) and
/// b(u) are made of.
///
///   auto allen_cahn = prdp::ImplicitStep(
///       prdp::OperatorSpec{"heat", {30}, {dt}, {nu}},
///       [=](const at::Tensor& u) { return u + dt * (u - u * u * u); }, prdp::CG{.max_iter = 20});
class ImplicitStep : public StepperBase {
 public:
  using OperatorAt = std::function<OperatorSpec(const at::Tensor& u)>;
  using RhsAt = std::function<at::Tensor(const at::Tensor& u)>;

  /// A and b as functions of the state; without an `rhs` (nullptr), b(u) = u. Raises ValueError for a missing operator
  /// or options out of range.
  ImplicitStep(OperatorAt a, RhsAt rhs, SolveOptions options);
  ImplicitStep(OperatorAt a, RhsAt rhs, Solver solver, Backward backward = Backward::kImplicit);
  /// One operator for all states.
  ImplicitStep(OperatorSpec a, RhsAt rhs, Solver solver, Backward backward = Backward::kImplicit);

  /// Raises ValueError or TypeError, before any work, if A(u), b(u) and u do not fit each other.
  at::Tensor operator()(const at::Tensor& u);
  /// Repeats the step. Returns all states, u included: (batch, steps + 1, …). info() and adjoint_info() then hold
  /// tensors (batch, steps). If a step fails, the error gives its number. Each step is one node of autograd.
  at::Tensor rollout(const at::Tensor& u, int64_t steps);

  OperatorSpec operator_at(const at::Tensor& u) const { return operator_(u); }
  at::Tensor rhs(const at::Tensor& u) const { return rhs_ ? rhs_(u) : u; }

 private:
  SolveResult solve(const at::Tensor& u, int64_t adjoint_log) const;
  SolveResult solve_from(const at::Tensor& u, int64_t adjoint_log) const;

  OperatorAt operator_;
  RhsAt rhs_;
};

}  // namespace prdp
