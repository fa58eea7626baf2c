#pragma once
#include "prdp/autograd/linear_solve.h"

namespace prdp {

/// A discretised equation, flat like an OperatorSpec: its state u gives the linear system
/// A(u) u_next = b(u). `kind` is "poisson", "heat", "burgers" or "navier_stokes"; `tensors` are those
/// of the operator that are not the state.
struct Equation {
  std::string kind;
  std::vector<int64_t> shape;
  std::vector<double> parameters;
  std::vector<at::Tensor> tensors;
  int64_t picard_steps = 1;  // solves a step, each linearised about the last one's solution

  /// Raises ValueError or TypeError for a bad shape or parameter.
  void check() const;
};

/// Whether A depends on the state.
bool is_flow(const Equation& equation);

/// The system's operator A(u) and right-hand side b(u) at the state u, both differentiable in u.
OperatorSpec equation_operator(const Equation& equation, const at::Tensor& u);
at::Tensor equation_rhs(const Equation& equation, const at::Tensor& u);
/// ū for b̄: b is linear in u, and this is its transpose.
at::Tensor equation_rhs_transposed(const Equation& equation, const at::Tensor& bar);

/// One step u → u_next; both (batch, channel, *shape). Also the torch op prdp::step. Its solves start as
/// options.start says, those of later Picard steps from the last solution. Over several Picard steps the info counts all iterations and holds the worst status; its residual is the last.
SolveResult step(const Equation& equation, const at::Tensor& u, const SolveOptions& options);

}  // namespace prdp
