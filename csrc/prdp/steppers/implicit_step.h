#pragma once
#include <functional>

#include "prdp/autograd/linear_solve.h"
#include "prdp/steppers/solving.h"

namespace prdp {

/// A step of an equation of your own: solves A(u) u_next = b(u) for any operator, with all that the built-in
/// steppers have. The state u is (batch, …), as the vectors of the operator; gradients reach u and whatever
/// tensors A(u) and b(u) are made of.
///
///   auto allen_cahn = prdp::ImplicitStep(
///       prdp::OperatorSpec{"heat", {30}, {dt}, {nu}},
///       [=](const at::Tensor& u) { return u + dt * (u - u * u * u); }, prdp::CG{.max_iter = 20});
class ImplicitStep : public Solving {
 public:
  using OperatorAt = std::function<OperatorSpec(const at::Tensor& u)>;
  using RhsAt = std::function<at::Tensor(const at::Tensor& u)>;

  /// A and b at a state; without an `rhs` (nullptr), b(u) = u. Raises ValueError for a missing operator or
  /// options out of range.
  ImplicitStep(OperatorAt a, RhsAt rhs, SolveOptions options);
  ImplicitStep(OperatorAt a, RhsAt rhs, Solver solver, Backward backward = Backward::kImplicit);
  /// One operator for all states.
  ImplicitStep(OperatorSpec a, RhsAt rhs, Solver solver, Backward backward = Backward::kImplicit);

  /// Raises ValueError or TypeError where A(u), b(u) and u do not fit each other, before any work.
  at::Tensor operator()(const at::Tensor& u);
  /// The states of `steps` steps, u included: (batch, steps + 1, …); info() and adjoint_info() then hold
  /// tensors (batch, steps). A failure says in which step. One node of autograd per step.
  at::Tensor rollout(const at::Tensor& u, int64_t steps);

  OperatorSpec operator_at(const at::Tensor& u) const { return operator_(u); }
  at::Tensor rhs(const at::Tensor& u) const { return rhs_ ? rhs_(u) : u; }

 private:
  SolveResult solve(const at::Tensor& u, int64_t adjoint_log) const;

  OperatorAt operator_;
  RhsAt rhs_;
};

}  // namespace prdp
