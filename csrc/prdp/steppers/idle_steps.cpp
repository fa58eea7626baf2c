#include "prdp/steppers/idle_steps.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>

#include "prdp/error_text.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/warnings.h"

namespace prdp {

void warn_of_idle_steps(const SolveInfo& info, double rtol, OnFailure on_failure) {
  constexpr int64_t fewest_steps = 8;
  constexpr double loose = 1e-4;  // a ToleranceController looks at larger residuals itself (controller_interval.py)
  constexpr double much = 20;     // times rtol, left out by all steps together
  const bool speaks = on_failure == OnFailure::kRaise || on_failure == OnFailure::kWarn;
  const auto& iterations = info.iterations;
  if (!speaks || iterations.dim() != 2 || iterations.sym_size(1) < fewest_steps || !(rtol > 0.0) || rtol > loose)
    return;
  if (!iterations.is_cpu() || !is_plain(iterations) || iterations.numel() == 0) return;
  const at::NoGradGuard no_grad;
  const int64_t steps = iterations.size(1);
  const auto residual = info.residual.to(at::kDouble);
  const auto idle = iterations.eq(0).logical_and(info.status.gt(0)).logical_and(residual.gt(0.1 * rtol));
  const auto left_out = residual.masked_fill(idle.logical_not(), 0.0).sum(1);
  // A march towards a steady state works before it rests.
  const auto first = idle.narrow(1, 0, std::max(fewest_steps, steps / 10)).to(at::kDouble).mean(1).gt(0.5);
  const auto rests = first.logical_and(left_out.gt(much * rtol));
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
