#include "prdp/steppers/idle_steps.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>

#include "prdp/error_text.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/warnings.h"

namespace prdp {

namespace {

/// Of each sample, whether the steps before its last iteration were mostly idle.
at::Tensor creeps(const at::Tensor& idle, const at::Tensor& iterations, const at::Tensor& left_out, double much) {
  const auto worked = iterations.gt(0).to(at::kLong);
  const auto before_last = worked.flip({1}).cumsum(1).flip({1}).gt(0);  // there is work in this step or a later one
  const auto waits = idle.logical_and(before_last);
  const auto mostly = waits.sum(1).mul(2).gt(before_last.sum(1));
  return mostly.logical_and(left_out.masked_fill(waits.logical_not(), 0.0).sum(1).gt(much));
}

}  // namespace

void warn_of_idle_steps(const SolveInfo& info, double rtol, OnFailure on_failure) {
  constexpr int64_t fewest_steps = 8;
  constexpr double loose = 1e-4;  // a ToleranceController looks at larger residuals itself (controller_interval.py)
  const double scale = std::min(rtol, loose), much = 20 * scale;  // left out by all steps together
  const bool speaks = on_failure == OnFailure::kRaise || on_failure == OnFailure::kWarn;
  const auto& iterations = info.iterations;
  if (!speaks || iterations.dim() != 2 || iterations.sym_size(1) < fewest_steps || !(rtol > 0.0)) return;
  if (!iterations.is_cpu() || !is_plain(iterations) || iterations.numel() == 0) return;
  const at::NoGradGuard no_grad;
  const int64_t steps = iterations.size(1);
  const auto residual = info.residual.to(at::kDouble);
  const auto converged = static_cast<int64_t>(SolveStatus::kConverged);
  const auto idle = iterations.eq(0).logical_and(info.status.eq(converged)).logical_and(residual.gt(0.1 * scale));
  const auto left_out = residual.masked_fill(idle.logical_not(), 0.0);
  const auto of_all = left_out.sum(1);
  const auto first = idle.narrow(1, 0, std::max(fewest_steps, steps / 10)).to(at::kDouble).mean(1).gt(0.5);
  // A march towards a steady state begins far from it, and works before it rests.
  const auto begins_near = iterations.select(1, 0).le(1);
  const auto stands = rtol > loose ? iterations.eq(0).all(1) : first.logical_and(begins_near);
  auto rests = stands.logical_and(of_all.gt(much));
  if (!(rtol > loose)) rests = rests.logical_or(creeps(idle, iterations, left_out, much));
  if (!rests.any().item<bool>()) return;
  const auto i = of_all.masked_fill(rests.logical_not(), 0.0).argmax().item<int64_t>();
  const double lost = of_all[i].item<double>();
  warn_once(c10::str("idle steps ", steps), lost, [&](std::ostream& text) {
    text << "rollout: of sample " << i << " " << idle[i].sum().item<int64_t>() << " of " << steps
         << " steps took no iteration: the state before met rtol = " << rtol
         << " already and was handed on. Unless it is steady, what they leave out adds up to as much as "
         << three_digits(lost) << " |b|. Take " << in_language("start=\"zero\"", "Start::kZero");
    const double enough = rtol / static_cast<double>(steps);
    if (enough > 100.0 * epsilon_of(info.residual)) text << ", or a smaller rtol, such as " << three_digits(enough);
  });
}

}  // namespace prdp
