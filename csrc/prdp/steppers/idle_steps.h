#pragma once
#include "prdp/solvers/solver.h"

namespace prdp {

/// Warns where a rollout hands its start on: most steps of a sample take no iteration, as the state before meets rtol
/// already, and the changes that they leave out add up. Looks at a report (batch, steps) on the CPU of at least eight
/// steps. A controller that has set a loose rtol tells of them itself.
void warn_of_idle_steps(const SolveInfo& info, double rtol, bool has_controller, OnFailure on_failure);

}  // namespace prdp
