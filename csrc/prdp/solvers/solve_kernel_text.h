#pragma once
#include "prdp/gpu/operator_view.h"
#include "prdp/gpu/runtime.h"
#include "prdp/solvers/solver.h"

namespace prdp::gpu {

/// A kernel that solves a batch, and what its launch needs.
struct SolveKernel {
  KernelSource source;
  int64_t memory_of_team;  // numbers in the device's memory
};

/// Whether there is a kernel for the method with its preconditioner; the operator must have a view beside.
bool has_kernel(const Solver& solver);

/// The choice of a team depends on the sample and the device, never on the batch: neighbours must not change a bit.
/// For vectors like b. The preconditioner is that of the saddle point, or that of a field. Raises Unavailable for a
/// sample that is too large.
SolveKernel solve_kernel(const OperatorView& a, bool is_saddle_point, const Solver& solver, const at::Tensor& b,
                         const Limits& limits);

}  // namespace prdp::gpu
