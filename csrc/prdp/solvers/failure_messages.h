#pragma once
#include <string>

#include "prdp/solvers/failed_sample.h"

namespace prdp {

/// A sentence about why the solve of this sample ended with this status, and what to do about it:
/// "Jacobi on NavierStokes: the pressure rows have a zero diagonal; take GMRES". It may take products with A.
std::string diagnosis(const FailedSample& sample, SolveStatus status);

}  // namespace prdp
