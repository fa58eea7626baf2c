#pragma once
#include "prdp/solvers/solve.h"

namespace prdp {

/// The ordinary case of a direct method on a device, at which the host looks once: every sample is solved to rtol by
/// the first solve, or its b is zero. Nothing in any other case, which the loop around the methods tells apart.
std::optional<SolveResult> solve_direct_at_once(const Operator& a, const at::Tensor& b, const SolveRequest& request);

}  // namespace prdp
