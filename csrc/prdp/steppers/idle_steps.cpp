#include "prdp/steppers/idle_steps.h"

#include <ATen/core/grad_mode.h>

#include "prdp/error_text.h"
#include "prdp/operators/plain_tensors.h"
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
  const auto idle = iterations.eq(0).logical_and(info.status.gt(0));
  const auto left_out = info.residual.to(at::kDouble).masked_fill(idle.logical_not(), 0.0).sum(1);
  // A march towards a steady state has worked before it rests.
  const auto rests = iterations.sum(1).le(steps / 2).logical_and(left_out.gt(much * rtol));
  if (!rests.any().item<bool>()) return;
  const auto i = left_out.masked_fill(rests.logical_not(), 0.0).argmax().item<int64_t>();
  const double lost = left_out[i].item<double>();
  warn_once("idle steps", lost, [&](std::ostream& text) {
    text << "rollout: of sample " << i << " " << idle[i].sum().item<int64_t>() << " of " << steps
         << " steps took no iteration: the state before met rtol = " << rtol
         << " already and was handed on. What they leave out adds up to as much as " << three_digits(lost)
         << " |b|. Take a smaller rtol, such as " << three_digits(rtol / static_cast<double>(steps)) << ", or "
         << in_language("start=\"zero\"", "Start::kZero");
  });
}

}  // namespace prdp
