#pragma once
#include "prdp/solvers/report_failures.h"
#include "prdp/solvers/solve.h"

namespace prdp {

/// Warns once where samples CONVERGED, and yet u is far off: rows that are much larger than others, as with a penalty
/// or a large weight of data, make up ‖b‖, and what rtol leaves of it is much for the small ones. It looks at the 1st,
/// 2nd, 4th, 8th, … solve of a kind on the CPU. `b`: without what A cannot reach.
void warn_of_uneven_rows(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveResult& result);

}  // namespace prdp
