#pragma once
#include "prdp/steppers/flow/step.h"

namespace prdp {

/// What steps of a flow return: the next state; the same with the pressure of the step as its last channel; all states.
enum class FlowOutput { kNext, kNextAndPressure, kStates };

/// Raises ValueError for options that no flow takes.
void check_flow_options(const SolveOptions& options);

/// The first or the second of them.
at::Tensor output_of(const FlowStep& step, FlowOutput output, double dt);

/// `steps` steps, one unless all states are asked for, as one node of autograd that keeps one state per step. For all
/// modes but the unrolled one. The report of several is (batch, steps).
SolveResult flow_steps(const FlowEquation& equation, const at::Tensor& u, int64_t steps, FlowOutput output,
                       const SolveOptions& options);

}  // namespace prdp
