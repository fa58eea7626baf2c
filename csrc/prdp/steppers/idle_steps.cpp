#include "prdp/steppers/idle_steps.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>

#include "prdp/error_text.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/warnings.h"

namespace prdp {

void warn_of_idle_steps(const SolveInfo& info, double rtol, bool has_controller, OnFailure on_failure) {
  constexpr int64_t fewest_steps = 8;
  constexpr double loose = 1e-4;
  const double scale = std::min(rtol, loose), much = 20 * scale;  // left out by all steps together
  const bool speaks = on_failure == OnFailure::kRaise || on_failure == OnFailure::kWarn;
  const auto& iterations = info.iterations;
  if (!speaks || iterations.dim() != 2 || iterations.sym_size(1) < fewest_steps || !(rtol > 0.0)) return;
  if (has_controller && rtol > loose) return;  // it looks at such residuals itself (controller_interval.py)
  if (!iterations.is_cpu() || !is_plain(iterations) || iterations.numel() == 0) return;
  const at::NoGradGuard no_grad;
  const int64_t steps = iterations.size(1);
  const auto residual = info.residual.to(at::kDouble);
  const auto converged = static_cast<int64_t>(SolveStatus::kConverged);
  const auto idle = iterations.eq(0).logical_and(info.status.eq(converged)).logical_and(residual.gt(0.1 * scale));
  const auto left_out = residual.masked_fill(idle.logical_not(), 0.0).sum(1);
  // A march towards a steady state begins far from it, and works in its first step.
  const auto begins_near = iterations.select(1, 0).le(1);
  const auto mostly = idle.to(at::kDouble).mean(1).gt(0.5);
  const auto rests = begins_near.logical_and(mostly).logical_and(left_out.gt(much));
  if (!rests.any().item<bool>()) return;
  const auto i = left_out.masked_fill(rests.logical_not(), 0.0).argmax().item<int64_t>();
  const double lost = left_out[i].item<double>();
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
