#pragma once
#include "prdp/solvers/solver.h"

namespace prdp {

/// Warns where a rollout hands its start on: most steps of a sample take no iteration, as the state before meets rtol
/// already, and the changes that they leave out add up. Looks at a report (batch, steps) on the CPU of at least eight
/// steps. Where rtol is so loose that a controller may have set it, no step must have taken one.
void warn_of_idle_steps(const SolveInfo& info, double rtol, OnFailure on_failure);

}  // namespace prdp
