#pragma once
#include "prdp/steppers/flow/step.h"

namespace prdp {

/// One step as one node of autograd, which keeps the state. In unrolled mode each solve is a node of its own.
SolveResult flow_next(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options);
/// The next state with the pressure of the step as its last channel: (batch, d + 1, *shape).
SolveResult flow_next_and_pressure(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options);
/// The states of several steps, (batch, steps + 1, d, *shape), as one node that keeps one state per step. Its info is
/// (batch, steps).
SolveResult flow_rollout(const FlowEquation& equation, const at::Tensor& u, int64_t steps, const SolveOptions& options);

}  // namespace prdp
