#pragma once
#include <functional>

#include "prdp/solvers/solve.h"

namespace prdp::gpu {

/// A solve in one launch, where the device, the method and the operator have a kernel; else nothing, and tensor
/// operations take its place: with one warning for each reason that is not the method or the operator itself. With
/// PRDP_GPU=required, every reason is an error. The report stays on the device.
std::optional<SolveResult> solve(const Operator& a, const at::Tensor& b, const SolveRequest& request);

/// A cycle of multigrid, M⁻¹ v or M⁻ᵀ v, for vectors like these, in one launch: an iteration of Multigrid from zero.
/// Empty where there is no kernel.
using Product = std::function<at::Tensor(const at::Tensor& v)>;
Product make_cycle(const Operator& a, bool transposed, const Preconditioner& m, const at::Tensor& like);

/// Whether solve() takes a kernel for vectors like b, if the operator has one: then the host need not wait for it.
bool may_run_kernel(const at::Tensor& b, const Solver& solver);

}  // namespace prdp::gpu
