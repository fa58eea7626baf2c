#pragma once
#include "prdp/autograd/linear_solve.h"

namespace prdp {

/// A discretised equation, flat like an OperatorSpec: its state u gives the linear system
/// A(u) u_next = b(u). `kind` is "poisson" or "heat".
struct Equation {
  std::string kind;
  std::vector<int64_t> shape;
  std::vector<double> parameters;
  std::vector<at::Tensor> tensors;
};

/// The system's operator A(u) and right-hand side b(u) at the state u.
OperatorSpec equation_operator(const Equation& equation, const at::Tensor& u);
at::Tensor equation_rhs(const Equation& equation, const at::Tensor& u);

/// One step u → u_next; both (batch, channel, *shape). Also the torch op prdp::step.
SolveResult step(const Equation& equation, const at::Tensor& u, const SolveOptions& options);

}  // namespace prdp
