#pragma once
#include "prdp/steppers/flow/step.h"

namespace prdp {

/// One step, or the states of several, (batch, steps + 1, d, *shape), as one node of autograd that keeps one state per
/// step. The info of several steps has tensors (batch, steps). In unrolled mode each solve is a node of its own.
SolveResult flow_next(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options);
/// The next state with the pressure of the step as its last channel: (batch, d + 1, *shape).
SolveResult flow_next_and_pressure(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options);
SolveResult flow_rollout(const FlowEquation& equation, const at::Tensor& u, int64_t steps, const SolveOptions& options);

}  // namespace prdp
