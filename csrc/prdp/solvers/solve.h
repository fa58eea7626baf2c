#pragma once
#include <functional>

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
          .guarded = request.guarded};
}

/// How the last solve of this thread was computed: "kernel", in one launch on a GPU, "loops" of the CPU, or "tensors";
/// "" before the first.
const char* way_of_last_solve();

/// solve() by plain tensor operations alone: for other devices, and as the tests' reference.
SolveResult solve_with_tensors(const Operator& a, const at::Tensor& b, const SolveRequest& request);

/// The least number of samples per thread, such that each thread has some 100 µs of work. With less work, a second
/// thread costs more than it saves. A cycle of GMRES counts as its products.
int64_t grain_size(Method method, int64_t samples, int64_t unknowns, int64_t iterations, int64_t restart);

/// u after exactly `caps` iterations of each sample, as `solver` took them on the way to its rtol, recorded
/// by autograd if b or the tensors of `a` require grad. The unrolled mode differentiates this map. The start is a
/// constant.
struct RecordedSolve {
  at::Tensor u, operator_applications;
};
RecordedSolve solve_recorded(const Operator& a, const at::Tensor& b, const at::Tensor& x0, const Solver& solver,
                             const at::Tensor& caps);

/// The same one iteration at a time, in plain tensor operations. Only for samples with caps > 0.
class StepwiseSolve {
 public:
  /// What one iteration needs from the one before it, x first; empty before the first.
  using State = std::vector<at::Tensor>;

  StepwiseSolve(const Operator& a, const Solver& solver, const at::Tensor& b, const at::Tensor& x0,
                const at::Tensor& caps);
  /// The scaled right-hand side of the iterations: b, or b - A start.
  const at::Tensor& rhs() const { return rhs_; }
  /// The state after iteration `done` + 1, from the state before it. A sample past its cap does not change.
  State step(const Operator& a, const at::Tensor& rhs, const State& before, int64_t done);
  /// P c x / scale, where u = start + P c x / scale, c being the scale of A. The same function takes ū to x̄. Known
  /// after the first step.
  at::Tensor scaled_back(const Operator& a, const at::Tensor& x) const {
    const auto u = a.project_solution(x) / scale_;
    return scale_of_a_.defined() ? u * scale_of_a_ : u;
  }
  /// The cotangent of b from that of rhs(): b̄ = P r̄ scale.
  at::Tensor bar_of_b(const Operator& a, const at::Tensor& rhs_bar) const { return a.project(rhs_bar) * scale_; }
  /// Where the iterations start; undefined if at zero.
  const at::Tensor& start() const { return start_; }
  int64_t iterations() const;  // the largest cap
  const std::vector<int64_t>& applications() const { return applications_; }

 private:
  Solver solver_;
  std::function<at::Tensor(const at::Tensor&)> inverse_;  // M⁻¹; empty: none, or the diagonal
  at::Tensor scale_, rhs_, start_;
  at::Tensor scale_of_a_, scale_of_inverse_;  // TensorSpace::System
  std::vector<double> b2_;  // of b, scaled
  std::vector<int64_t> caps_, applications_;
};

/// The solve that a report is about.
struct SolveRole {
  const OperatorSpec& a;  // transposed for an adjoint solve
  const Solver& solver;
  bool adjoint;
  at::Tensor x0{};
};

/// Raises c10::LinAlgError, warns or does nothing about failed samples, as `on_failure` says. The message names the
/// samples, the operator, the cause and a remedy (failure_messages.h). Where none failed, it warns once of samples that
/// stagnated far above rtol, unless nobody wants to hear of failures.
void report_failures(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveInfo& info,
                     OnFailure on_failure);

/// Says once that an unrolled gradient of A takes the cycles of multigrid for constants.
void warn_of_constant_cycles();

/// While it exists, reports on this thread name this step of a rollout, counted from 1.
class FailuresOfStep {
 public:
  FailuresOfStep(int64_t step, int64_t steps);
  FailuresOfStep(const FailuresOfStep&) = delete;
  ~FailuresOfStep();
  /// The step that this thread is in, and the number of steps; 0 and 0 outside of a rollout.
  static std::pair<int64_t, int64_t> now();

 private:
  int64_t step_before_, steps_before_;
};

/// Sets where warnings go. By default torch prints them on stderr.
using WarningSink = void (*)(const std::string& text);
void set_warning_sink(WarningSink sink);

}  // namespace prdp
