#pragma once
#include "prdp/solvers/solve.h"

namespace prdp::gpu {

/// Whether the residuals that a kernel reports are those of its solutions, which tensor operations compute from A, to
/// rounding. Samples that failed, and those whose numbers may leave the range of the dtype, are passed over.
bool residuals_agree(const Operator& a, const at::Tensor& b, const SolveResult& result);

}  // namespace prdp::gpu
