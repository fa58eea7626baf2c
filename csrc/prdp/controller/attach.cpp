#include "prdp/controller/attach.h"

#include <algorithm>

namespace prdp {

void set_budget(StepperBase& stepper, const Budget& budget) {
  stepper.set_max_iter(budget.max_iter);
  auto& options = stepper.options();
  if (budget.adjoint_max_iter) options.adjoint_max_iter = *budget.adjoint_max_iter;
  if (budget.rtol) {
    options.solver.rtol = *budget.rtol;
    stepper.follow_controller();
  }
  if (budget.adjoint_rtol) options.adjoint_rtol = budget.adjoint_rtol;
}

Solves last_solves(const std::vector<const StepperBase*>& steppers) {
  Solves solves(!steppers.empty());
  for (const auto* stepper : steppers) {
    TORCH_CHECK_VALUE(stepper, "last_solves: a stepper is null");
    solves.converged = solves.converged && stepper->converged();
    if (!stepper->info()) continue;
    const auto& info = *stepper->info();
    const auto beyond_rounding = info.residual.masked_fill(info.floor.gt(0), 0.0);
    const auto counts = info.status.ge(static_cast<int64_t>(SolveStatus::kStagnated));  // those that did not fail
    const auto of_counted = beyond_rounding.masked_fill(counts.logical_not(), 0.0).to(at::kDouble).sum().item<double>();
    const auto counted = counts.sum().item<int64_t>();
    if (counted > 0)
      solves.residual = std::max(of_counted / static_cast<double>(counted), solves.residual.value_or(0.0));
    const auto idle = info.iterations.eq(0) & info.status.gt(0) & (beyond_rounding > kSmallResidual);  // K may be 0
    solves.idle = std::max(solves.idle, idle.to(at::kDouble).mean().item<double>());
  }
  return solves;
}

}  // namespace prdp
