#pragma once
#include "prdp/gpu/runtime.h"
#include "prdp/solvers/solve.h"

namespace prdp::gpu {

/// Checks the first result of a kernel against tensor operations: the residuals that it reports are those of its
/// solutions, to rounding, and samples that failed by a NaN or Inf fail without the kernel, too. Trust::kUnknown where
/// numbers may leave the range of the dtype.
Trust verify_first_result(const Operator& a, const at::Tensor& b, const SolveRequest& request,
                          const SolveResult& result);

}  // namespace prdp::gpu
