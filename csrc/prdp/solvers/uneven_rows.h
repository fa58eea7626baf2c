#pragma once
#include "prdp/solvers/report_failures.h"
#include "prdp/solvers/solve.h"

namespace prdp {

/// Warns where a sample is CONVERGED though u is far off. Rows that are much larger than others, such as those of a
/// penalty or of a large weight of data, make up ‖b‖, and a residual of rtol ‖b‖ is large for the small rows. Checks
/// solves on the CPU as should_look() says. `b` lies in the range of A.
void warn_of_uneven_rows(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveResult& result,
                         bool looks_at_channels);

}  // namespace prdp
