#pragma once
#include "prdp/gpu/runtime.h"
#include "prdp/solvers/solve.h"

namespace prdp::gpu {

/// What a result tells of its kernel: whether the residuals that it reports are those of its solutions, which tensor
/// operations compute from A, to rounding; nothing where numbers may leave the range of the dtype. And whether samples
/// that failed by a NaN or Inf fail without the kernel, too.
Trust trust_by(const Operator& a, const at::Tensor& b, const SolveRequest& request, const SolveResult& result);

}  // namespace prdp::gpu
