#pragma once
#include "prdp/gpu/device/flow.h"
#include "prdp/solvers/solver.h"
#include "prdp/steppers/flow/equation.h"

namespace prdp {

/// With central differences and implicit diffusion a step of explicit Euler lets no wave grow up to √(2 ν dt)/dx, for
/// the dx along the wind, which may be the largest. Up to 1 waves grow slowly. An explicit step of upwind advection and
/// diffusion is a mean of neighbours while the two numbers are at most 1 together.
gpu::CourantLimit courant_limit(const FlowEquation& equation);

/// The samples that cannot be advected: their step is too long, or they or their force are not finite.
struct RefusedSamples {
  at::Tensor mask;    // bool (batch,)
  at::Tensor status;  // int64 (batch,): DIVERGED or NONFINITE_INPUT
};
/// None of them: undefined tensors. u has its boundary values.
RefusedSamples find_refused(const FlowEquation& equation, const at::Tensor& u);
/// Those that a kernel found, where status, (batch,), is not 0. The host waits for it.
RefusedSamples refused_by(const at::Tensor& status);
/// Raises c10::LinAlgError or warns about them.
void report_refused(const FlowEquation& equation, const at::Tensor& u, const RefusedSamples& refused,
                    OnFailure on_failure);

}  // namespace prdp
