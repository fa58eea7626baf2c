#include "prdp/controller/attach.h"

#include <algorithm>
#include <cmath>

namespace prdp {

void set_budget(StepperBase& stepper, const Budget& budget) {
  stepper.set_max_iter(budget.max_iter);
  auto& options = stepper.options();
  if (budget.adjoint_max_iter) options.adjoint_max_iter = *budget.adjoint_max_iter;
  if (budget.rtol) options.solver.rtol = *budget.rtol;
  if (budget.adjoint_rtol) options.adjoint_rtol = budget.adjoint_rtol;
}

Solves last_solves(const std::vector<const StepperBase*>& steppers) {
  Solves solves(!steppers.empty());
  for (const auto* stepper : steppers) {
    solves.converged = solves.converged && stepper->converged();
    if (!stepper->info()) continue;
    const auto& info = *stepper->info();
    const auto beyond_rounding = info.residual.masked_fill(info.floor.gt(0), 0.0);
    const auto residual = beyond_rounding.to(at::kDouble).mean().item<double>();
    if (std::isfinite(residual)) solves.residual = std::max(residual, solves.residual.value_or(0.0));
    const auto idle = info.iterations.eq(0) & info.status.gt(0) & (beyond_rounding > kSmallResidual);  // K may be 0
    solves.idle = std::max(solves.idle, idle.to(at::kDouble).mean().item<double>());
  }
  return solves;
}

}  // namespace prdp
