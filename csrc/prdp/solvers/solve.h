#pragma once
#include "prdp/operators/operator.h"
#include "prdp/solvers/batch_arrays.h"
#include "prdp/solvers/solver.h"

namespace prdp {

struct SolveResult {
  at::Tensor u;
  SolveInfo info;
};

/// A solve without derivatives. `caps` (int64, (batch,)) gives each sample its own max_iter. If not `guarded`, u is the
/// last iterate of every sample, even if it diverged. `x0`, with the shape of b, is a guess that is scaled as
/// linear_solve() describes; if undefined, the iterations start from zero.
struct SolveRequest {
  Solver solver;
  std::optional<at::Tensor> caps{};
  bool guarded = true;
  at::Tensor x0{};
  /// Whether no cycle of GMRES ends early: those that are differentiated iteration by iteration, as the derivative of
  /// the last products is rounding.
  bool whole_cycles = false;
  /// Whether the host may wait for another device to read the report there; the kernels of solve_on_gpu.h never wait.
  bool may_wait = true;
  /// What of A is looked at where a kernel of a GPU was to look, and none runs.
  Checks checks = Checks::kShared;
  /// As in SolveOptions.
  bool report_apart = false;
  gpu::KeptHierarchy* hierarchy = nullptr;
};

/// For what has been checked: arguments that do not fit each other read beyond their memory. Others take
/// linear_solve().
///
/// Solves A u = b by a kernel of a GPU, by the CPU loops, or by plain tensor operations where there is neither. Samples
/// do not influence each other; in kernels and loops not even in the last bit.
SolveResult solve(const Operator& a, const at::Tensor& b, const SolveRequest& request);

/// The report of what came of these samples, with numbers of this dtype.
SolveInfo info_of(const std::vector<SampleOutcome>& outcomes, at::ScalarType real);

/// The arrays of a request for b and its result. The tensors are contiguous, and on one device; `caps` and `x0`, as in
/// the request, may be undefined.
template <class T>
BatchArrays<T> arrays_of(const SolveRequest& request, const at::Tensor& b, const at::Tensor& x0, const at::Tensor& caps,
                         const SolveResult& result) {
  const auto& [u, info] = result;
  return {.b = b.const_data_ptr<T>(),
          .x0 = x0.defined() ? x0.const_data_ptr<T>() : nullptr,
          .u = u.mutable_data_ptr<T>(),
          .caps = caps.defined() ? caps.const_data_ptr<int64_t>() : nullptr,
          .report = {.iterations = info.iterations.mutable_data_ptr<int64_t>(),
                     .status = info.status.mutable_data_ptr<int64_t>(),
                     .applications = info.operator_applications.mutable_data_ptr<int64_t>(),
                     .residual = info.residual.mutable_data_ptr<T>(),
                     .floor = info.floor.mutable_data_ptr<T>()},
          .max_iter = request.solver.max_iter.expect_int(),
          .rtol = request.solver.rtol,
          .guarded = request.guarded,
          .whole_cycles = request.whole_cycles};
}

/// How the last solve of this thread was computed: "kernel", in one launch on a GPU, "loops" of the CPU, or "tensors";
/// "" before the first.
const char* way_of_last_solve();

/// solve() by plain tensor operations alone: for other devices, and as the tests' reference.
SolveResult solve_with_tensors(const Operator& a, const at::Tensor& b, const SolveRequest& request);

/// The least number of samples per thread, such that each thread has some 100 µs of work. With less work, a second
/// thread costs more than it saves. A cycle of GMRES counts as its products.
int64_t grain_size(Method method, int64_t samples, int64_t unknowns, int64_t iterations, int64_t restart);

}  // namespace prdp
