#pragma once
#include <string>

#include "prdp/solvers/solver.h"

namespace prdp {

/// Raises c10::LinAlgError or warns about the failures that `text` names, with the step of the rollout; only for kRaise
/// and kWarn.
void raise_or_warn(const std::string& text, OnFailure on_failure);

/// Warns that ⟨λ, b⟩ and ⟨u, ū⟩ of a sample differ, so that a Function's adjoint solve was made with another A.
void warn_of_another_transpose(const void* code, int64_t sample, double of_solve, double of_adjoint);

}  // namespace prdp
