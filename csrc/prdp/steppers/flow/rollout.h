#pragma once
#include "prdp/solvers/solve.h"
#include "prdp/steppers/flow/equation.h"

/// Steps of a flow with their derivative: one node of autograd (step_node.h), or in unrolled mode a node for each
/// solve.
namespace prdp {

SolveResult flow_next(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options);
/// The next state with the pressure of the step as its last channel: (batch, d + 1, *shape).
SolveResult flow_next_and_pressure(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options);
/// The states of several steps, (batch, steps + 1, d, *shape). Its info is (batch, steps).
SolveResult flow_rollout(const FlowEquation& equation, const at::Tensor& u, int64_t steps, const SolveOptions& options);

}  // namespace prdp
