#pragma once
#include <string>

#include "prdp/solvers/solver.h"

namespace prdp {

/// Raises c10::LinAlgError or warns about the failures that `text` names, with the step of the rollout; only for kRaise
/// and kWarn.
void raise_or_warn(const std::string& text, OnFailure on_failure);

}  // namespace prdp
