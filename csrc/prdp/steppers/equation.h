#pragma once
#include "prdp/autograd/linear_solve.h"

namespace prdp {

/// A discretised equation as plain numbers and tensors, like an OperatorSpec. At a state u it gives the linear system
/// A(u) u_next = b(u). `kind` is "poisson", "heat", "burgers" or "navier_stokes". `tensors` are those of the operator
/// without the state.
struct Equation {
  std::string kind;
  std::vector<int64_t> shape;
  std::vector<double> parameters;
  std::vector<at::Tensor> tensors;
  int64_t picard_steps = 1;  // solves per step, each linearised about the solution of the one before

  /// Raises ValueError or TypeError for a bad shape or parameter.
  void check() const;
  void check_picard_steps() const;
};

/// The operator A(u) and the right-hand side b(u) at the state u, both differentiable in u.
OperatorSpec equation_operator(const Equation& equation, const at::Tensor& u);
at::Tensor equation_rhs(const Equation& equation, const at::Tensor& u);
/// The cotangent of u from that of b. b is linear in u, and this is its transpose.
at::Tensor equation_rhs_transposed(const Equation& equation, const at::Tensor& bar);

/// The report of two solves of a step, one behind the other: all iterations, the worst status, the last residual.
SolveInfo joined(const SolveInfo& before, const SolveInfo& last);

/// One step u → u_next, both (batch, channel, *shape). Also the torch op prdp::step. With Start::kState, later Picard
/// steps start from the last solution. Their reports are joined().
SolveResult step(const Equation& equation, const at::Tensor& u, const SolveOptions& options);

}  // namespace prdp
