#pragma once
#include <string>

#include "prdp/solvers/report_failures.h"

namespace prdp {

/// A sentence about why the solve of this sample failed, and what to do about it:
/// "Jacobi on NavierStokes: the pressure rows have a zero diagonal; take GMRES". It may take products with A.
std::string diagnosis(const SolveRole& role, const Operator& a, const at::Tensor& b, SolveStatus status,
                      int64_t sample);

}  // namespace prdp
