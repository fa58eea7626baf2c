#pragma once
#include "prdp/steppers/flow/counted_solves.h"

namespace prdp {

/// One time step (Chorin 1968): advect, take the pressure off, diffuse, project. `potential` is dt times its pressure,
/// (batch, 1, *shape).
struct FlowStep {
  at::Tensor u, potential;
  SolveInfo info;
};

/// Written in differentiable pieces. Samples whose step is too long for the explicit part, or whose state is not
/// finite, fail as options.on_failure says: then u and the potential are zero and carry no gradient. If not `reported`,
/// nothing is said about these.
FlowStep flow_step(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options,
                   bool reported = true);

/// The cotangents of the next state and, if it is defined, of the potential.
struct FlowCotangent {
  at::Tensor u, potential{};
};

/// The gradients of u and the tensors of the equation from these, in implicit mode: undefined where `needed` holds 0.
/// Needs the state u alone. Where autograd records, they are differentiable. `info`: the report of the adjoint solves;
/// left empty where autograd records.
std::vector<at::Tensor> flow_step_vjp(const FlowEquation& equation, const at::Tensor& u, const FlowCotangent& cotangent,
                                      const SolveOptions& options, at::IntArrayRef needed, SolveInfo& info);

}  // namespace prdp
