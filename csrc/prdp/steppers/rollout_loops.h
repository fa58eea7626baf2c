#pragma once
#include <algorithm>
#include <utility>
#include <vector>

#include "prdp/autograd/adjoint_log.h"
#include "prdp/autograd/linear_solve.h"
#include "prdp/solvers/warnings.h"
#include "prdp/threads/interruption.h"

/// Rows of solves, forwards and back, for the rollouts of all steppers.
namespace prdp {

/// The reports of several solves as one, with tensors (batch, solves). If there are none, `u` gives the batch and the
/// dtype.
SolveInfo side_by_side(std::vector<SolveInfo> infos, const at::Tensor& u);

/// The solutions (batch, solves + 1, …) of a rollout whose steps have no derivative: the first is u, which has one.
at::Tensor from_state(const at::Tensor& u, const at::Tensor& solutions);

/// The solutions u, …, (batch, solves + 1, …), where `next(solution, s)` returns what solve s makes of the one before
/// it, with its report; so many solves are a step. Autograd sees each solve by itself.
template <class Next>
SolveResult solve_by_solve(const at::Tensor& u, int64_t solves, int64_t of_step, const Next& next) {
  std::vector<at::Tensor> solutions{u};
  std::vector<SolveInfo> infos;
  for (int64_t s = 0; s < solves; ++s) {
    const FailuresOfStep here(s / of_step + 1, solves / of_step);
    auto [solution, info] = next(solutions.back(), s);
    solutions.push_back(std::move(solution));
    infos.push_back(std::move(info));
  }
  return {at::stack(solutions, 1), side_by_side(std::move(infos), u)};
}

/// The same where autograd does not look on: each solution goes into its place at once, and is held a second time only
/// until the next one is there.
template <class Next>
SolveResult solve_in_place(const at::Tensor& u, int64_t solves, int64_t of_step, const Next& next) {
  auto sizes = u.sizes().vec();
  sizes.insert(sizes.begin() + 1, solves + 1);
  const auto solutions = at::empty(sizes, u.options());
  solutions.select(1, 0).copy_(u);
  std::vector<SolveInfo> infos;
  auto last = u;
  for (int64_t s = 0; s < solves; ++s) {
    const FailuresOfStep here(s / of_step + 1, solves / of_step);
    interruption::Watch::local().spend(u.numel());
    auto [solution, info] = next(last, s);
    last = std::move(solution);
    solutions.select(1, s + 1).copy_(last);
    infos.push_back(std::move(info));
  }
  return {solutions, side_by_side(std::move(infos), u)};
}

/// The reverse, from the cotangent (batch, solves + 1, …) of the solutions: `back(s)` takes the cotangent of solution
/// s + 1 through solve s and returns the report of its adjoint solve, if there is one. The log gets all of them.
template <class Back>
void solve_by_solve_back(const at::Tensor& cotangent, int64_t of_step, const c10::SymInt& log, const Back& back) {
  const int64_t solves = cotangent.size(1) - 1;
  std::vector<SolveInfo> infos;
  for (int64_t s = solves - 1; s >= 0; --s) {
    const FailuresOfStep here(s / of_step + 1, solves / of_step);
    interruption::Watch::local().spend(cotangent.numel() / cotangent.size(1));
    if (SolveInfo info = back(s); info.status.defined()) infos.push_back(std::move(info));
  }
  std::reverse(infos.begin(), infos.end());
  if (log != 0) adjoint_log::write(log, side_by_side(std::move(infos), cotangent));
}

}  // namespace prdp
