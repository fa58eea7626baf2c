#include "prdp/steppers/rollout_vjp.h"

#include <utility>

#include "prdp/autograd/solve_vjp.h"
#include "prdp/operators/tensors.h"
#include "prdp/steppers/equation_kinds.h"
#include "prdp/steppers/rollout_loops.h"
#include "prdp/steppers/stepper.h"

namespace prdp {

namespace {

at::Tensor at_solve(const at::Tensor& of_solves, int64_t s) {
  return of_solves.defined() ? of_solves.select(1, s) : of_solves;
}

/// What solve s found, and for unrolled derivatives what it was of; `first` is the first solve of its step.
Solved solved_at(const KeptSolves& kept, int64_t s, int64_t first, const Equation& equation,
                 const SolveOptions& options) {
  Solved solved{{},
                at_solve(kept.solutions, s + 1),
                at_solve(kept.iterations, s),
                at_solve(kept.status, s),
                at_solve(kept.residual, s)};
  if (options.backward == Backward::kUnrolled) {
    solved.b = equation_rhs(equation, at_solve(kept.solutions, first));
    solved.x0 = start_of_step(options, at_solve(kept.solutions, s));
  }
  return solved;
}

}  // namespace

std::vector<at::Tensor> vjp_of_solves(const at::Tensor& cotangent, const KeptSolves& kept, const Equation& equation,
                                      const SolveOptions& options, at::IntArrayRef needed,
                                      decltype(linear_solve)& adjoint_solve) {
  const int64_t picard = equation.picard_steps;
  const auto& kind = equation_kind(equation.kind);
  const bool rhs_is_state = !kind.rhs;
  auto each = options;
  each.adjoint_log = 0;
  // Before solve s is taken back, bars[s + 1] has all that reaches its solution, and it is empty afterwards: what it
  // gives goes to bars[s], about which A is linearised, and by way of b to bars[first]. Where b is not the state, b̄ of
  // all solves of a step is summed in rhs_bar, and goes on with the first of them.
  auto bars = cotangent.unbind(1);
  std::vector<at::Tensor> of_tensors(equation.tensors.size());
  at::Tensor rhs_bar;
  solve_by_solve_back(cotangent, picard, options.adjoint_log, [&](int64_t s) {
    const int64_t first = s - s % picard;
    if (options.on_failure == OnFailure::kZeroGrad && s == first + picard - 1)  // whichever solve of the step failed
      bars[s + 1] = without_failed(bars[s + 1], kept.status.slice(1, first, s + 1).amin(1), options.on_failure);
    const auto a = equation_operator(equation, at_solve(kept.solutions, s));
    const auto solved = solved_at(kept, s, first, equation, options);
    std::vector<int64_t> wanted(needed.begin(), needed.end());
    wanted[0] = needed[0] || first > 0;
    if (kind.linearised) wanted.insert(wanted.begin() + 1, needed[0] || s > 0);
    const auto [gradients, info] = solve_vjp(std::exchange(bars[s + 1], {}), solved, a, each, wanted, adjoint_solve);
    add_to(rhs_is_state ? bars[first] : rhs_bar, gradients[0]);
    if (kind.linearised) add_to(bars[s], gradients[1]);
    if (s == first && rhs_bar.defined()) {
      add_to(bars[s], equation_rhs_transposed(equation, rhs_bar));
      rhs_bar = at::Tensor();
    }
    const size_t others = gradients.size() - of_tensors.size();
    for (size_t i = 0; i < of_tensors.size(); ++i) add_to(of_tensors[i], gradients[others + i]);
    return info;
  });
  std::vector<at::Tensor> found{needed[0] ? bars[0] : at::Tensor()};
  found.insert(found.end(), of_tensors.begin(), of_tensors.end());
  return found;
}

}  // namespace prdp
