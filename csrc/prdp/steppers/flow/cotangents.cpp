#include "prdp/steppers/flow/cotangents.h"

#include <ATen/core/grad_mode.h>

#include <cmath>
#include <limits>

#include "prdp/autograd/solve_vjp.h"
#include "prdp/error_text.h"
#include "prdp/operators/operator.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/report_failures.h"
#include "prdp/solvers/warnings.h"
#include "prdp/steppers/flow/kernels.h"

namespace prdp {

namespace {

void report_nonfinite(const at::Tensor& bar, const at::Tensor& refused, OnFailure on_failure) {
  const auto samples = refused.nonzero().flatten();
  if (on_failure == OnFailure::kReturn || on_failure == OnFailure::kZeroGrad)
    return warn_of_lost_cotangents("Flow: adjoint step", samples.size(0), bar.size(0));
  const auto first = samples[0].item<int64_t>();
  raise_or_warn(c10::str("Flow: adjoint step: ", samples.size(0), " of ", bar.size(0), " samples failed: sample ",
                         first, " NONFINITE_INPUT at index ", as_tuple(first_true(nonfinite(bar[first]))),
                         ": the cotangent is NaN or Inf there; look at the loss",
                         in_language(", at the scale of a GradScaler,", ""), " or at the steps after this one"),
                on_failure);
}

}  // namespace

SolveInfo UsableCotangent::reported(SolveInfo info) const {
  if (!refused.defined() || !info.status.defined()) return info;
  info.status = info.status.masked_fill(refused, static_cast<int64_t>(SolveStatus::kNonfiniteInput));
  info.residual = info.residual.masked_fill(refused, std::numeric_limits<double>::infinity());
  return info;
}

UsableCotangent usable_cotangent(const at::Tensor& cotangent, const at::Tensor& status, bool has_pressure,
                                 OnFailure on_failure) {
  auto bar = status.defined() ? without_failed(cotangent, status, on_failure) : cotangent;
  if (flow_kernels::can_run(bar) && !has_pressure) return {bar};
  // One pass, which almost always ends it: a NaN or Inf is in the sum as well.
  if (bar.is_cpu() && std::isfinite(bar.detach().sum().item<double>())) return {bar};
  const auto refused = nonfinite(bar.detach()).flatten(1).any(1);
  if (bar.is_cpu() || on_failure == OnFailure::kRaise || on_failure == OnFailure::kWarn) {  // the host may look
    if (!refused.any().item<bool>()) return {bar};
    report_nonfinite(bar.detach(), refused, on_failure);
  }
  return {cleared(bar, refused), refused};
}

}  // namespace prdp
