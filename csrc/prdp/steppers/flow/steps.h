#pragma once
#include "prdp/steppers/flow/step.h"

namespace prdp {

/// One step, or the states of several, (batch, steps + 1, d, *shape), as one node of autograd that keeps one state per
/// step. The info of several steps has tensors (batch, steps). In unrolled mode each solve is a node of its own.
SolveResult flow_next(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options);
SolveResult flow_rollout(const FlowEquation& equation, const at::Tensor& u, int64_t steps, const SolveOptions& options);

}  // namespace prdp
