#pragma once
#include <array>
#include <vector>

#include "prdp/autograd/linear_solve.h"
#include "prdp/steppers/equation.h"

namespace prdp {

/// What the solves of a rollout store for their derivative; undefined if it is not needed.
struct KeptSolves {
  at::Tensor solutions, iterations, status, residual;  // (batch, solves (+ 1), …)

  /// All of them, in this order.
  std::array<at::Tensor*, 4> parts() { return {&solutions, &iterations, &status, &residual}; }
};

/// The product of the cotangent (batch, solves + 1, channel, *shape) of all solutions of a rollout
/// (rollout_node.h) with its derivative: gradients of u and of each tensor of the equation, undefined where
/// `needed` (u first) holds 0 or there is none. Sums run in the order in which autograd takes the steps
/// of a chain. Where autograd records, it is differentiable, if `adjoint_solve` is.
std::vector<at::Tensor> vjp_of_solves(const at::Tensor& cotangent, const KeptSolves& kept, const Equation& equation,
                                      const SolveOptions& options, at::IntArrayRef needed,
                                      decltype(linear_solve)& adjoint_solve);

}  // namespace prdp
