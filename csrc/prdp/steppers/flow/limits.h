#pragma once
#include "prdp/solvers/solver.h"
#include "prdp/steppers/flow/equation.h"

namespace prdp {

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
