#pragma once
#include <vector>

#include "prdp/autograd/linear_solve.h"
#include "prdp/steppers/equation.h"

namespace prdp {

/// Collects the reports of the solves of a rollout, one after the other.
class Reports {
 public:
  void push(const SolveInfo& info);
  void reverse();
  /// Tensors (batch, solves). If there are none, `u` gives the batch and the dtype.
  SolveInfo joined(const at::Tensor& u) const;

 private:
  std::vector<at::Tensor> iterations_, residual_, status_, applications_, floor_;
};

/// The solutions u, …, (batch, solves + 1, …), where `next(solution, s)` returns what solve s makes of the one before
/// it, with its report; so many solves are a step. Autograd sees each solve by itself.
template <class Next>
SolveResult solve_by_solve(const at::Tensor& u, int64_t solves, int64_t of_step, const Next& next) {
  std::vector<at::Tensor> solutions{u};
  Reports reports;
  for (int64_t s = 0; s < solves; ++s) {
    const FailuresOfStep here(s / of_step + 1, solves / of_step);
    auto [solution, info] = next(solutions.back(), s);
    solutions.push_back(std::move(solution));
    reports.push(info);
  }
  return {at::stack(solutions, 1), reports.joined(u)};
}

/// What the solves of a rollout store for their derivative; undefined if it is not needed.
struct KeptSolves {
  at::Tensor solutions, iterations, status, residual;  // (batch, solves (+ 1), …)
};

/// The product of the cotangent (batch, solves + 1, channel, *shape) of all solutions of a rollout
/// (rollout.cpp) with its derivative: gradients of u and of each tensor of the equation, undefined where
/// `needed` (u first) holds 0 or there is none. Sums run in the order in which autograd takes the steps
/// of a chain. Where autograd records, it is differentiable, if `adjoint_solve` is.
std::vector<at::Tensor> vjp_of_solves(const at::Tensor& cotangent, const KeptSolves& kept, const Equation& equation,
                                      const SolveOptions& options, at::IntArrayRef needed,
                                      decltype(linear_solve)& adjoint_solve);

}  // namespace prdp
