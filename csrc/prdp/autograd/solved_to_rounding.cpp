#include "prdp/autograd/solved_to_rounding.h"

#include <algorithm>
#include <cmath>

#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/solve.h"

namespace prdp {

namespace {

/// ‖u‖/‖b‖ of each sample, whatever their order of magnitude.
std::vector<double> growth(const at::Tensor& u, const at::Tensor& b) {
  const auto norm = [](const at::Tensor& t) {
    const auto rows = t.detach().to(at::kDouble).flatten(1);
    const auto largest = rows.abs().amax(1, /*keepdim=*/true);
    return std::pair((rows / largest).norm(2, 1), largest.squeeze(1));
  };
  const auto [u_norm, u_largest] = norm(u);
  const auto [b_norm, b_largest] = norm(b);
  return to_host<double>(u_norm / b_norm * (u_largest / b_largest), b.size(0));
}

/// Those of the candidates whose residual is no more than the rounding errors of computing it, and less than √ε; where
/// one may be, u is asked for.
Rows within_rounding(const Operator& a, const Solved& solved, const Rows& candidates, const MakeSolution& make_u) {
  const int64_t batch = solved.b.size(0);
  const double epsilon = epsilon_of(solved.b);
  const auto residual = to_host<double>(solved.residual, batch);
  const auto status = to_host<int64_t>(solved.status, batch);
  Rows rows(batch, false), near(batch, false);
  for (int64_t i = 0; i < batch; ++i) {
    const auto s = static_cast<SolveStatus>(status[i]);
    if (!candidates[i] || is_refused(s)) continue;
    rows[i] = s == SolveStatus::kConvergedBreakdown || residual[i] == 0.0;
    near[i] = !rows[i] && residual[i] <= std::sqrt(epsilon);
  }
  if (!any(near)) return rows;
  const auto norm = to_host<double>(a.norm(), batch), u_over_b = growth(make_u(), solved.b);
  for (int64_t i = 0; i < batch; ++i)
    rows[i] = rows[i] || (near[i] && residual[i] <= kRoundings * epsilon / 2 * (norm[i] * u_over_b[i] + 1.0));
  return rows;
}

}  // namespace

Rows solved_to_rounding(const Operator& a, const Solved& solved, const Solver& solver, const MakeSolution& make_u) {
  const int64_t batch = solved.b.size(0);
  const auto iterations = to_host<int64_t>(solved.iterations, batch);
  Rows candidates(batch, true);
  if (traits(solver.method).is_polynomial)
    for (int64_t i = 0; i < batch; ++i) candidates[i] = iterations[i] != solver.max_iter.expect_int();
  auto rows = within_rounding(a, solved, candidates, make_u);
  if (!any(rows)) return rows;
  const int64_t unknowns = solved.b.numel() / batch;
  if (traits(solver.method).ends_at_unknowns &&
      std::find(iterations.begin(), iterations.end(), unknowns) != iterations.end()) {
    auto shorter = solver;
    shorter.max_iter = unknowns - 1;
    shorter.rtol = 0.0;
    const auto one_less = solve(a, solved.b.detach(), {shorter, {}, true, solved.x0});
    const Solved before{solved.b, one_less.u, {}, one_less.info.status, one_less.info.residual};
    const auto sufficed = within_rounding(a, before, rows, [&] { return one_less.u; });
    for (int64_t i = 0; i < batch; ++i) rows[i] = rows[i] && (iterations[i] != unknowns || sufficed[i]);
  }
  return rows;
}

}  // namespace prdp
