#pragma once
#include "prdp/operators/operator.h"
#include "prdp/solvers/solver.h"
#include "prdp/solvers/status.h"

namespace prdp {

struct SolveResult {
  at::Tensor u;
  SolveInfo info;
};

/// A solve without derivatives. `caps` (int64, (batch,)) gives each sample its own max_iter. Not guarded, u
/// is what the iterations make of b, however large: no better iterate and no zeros in its place. `x0`, like b, is
/// where the iterations start, once it is scaled as linear_solve() says; undefined: from zero.
struct SolveRequest {
  Method method;
  int64_t max_iter;
  double rtol;
  int64_t restart;
  std::optional<at::Tensor> caps{};
  bool guarded = true;
  at::Tensor x0{};
};

/// A u = b by the CPU loops, or by plain tensor operations where there are none for the operator or
/// the device. Samples do not influence each other; on the CPU loops not even in the last bit.
SolveResult solve(const Operator& a, const at::Tensor& b, const SolveRequest& request);

/// The same in plain tensor operations: the oracle for the CPU loops, and the way of other devices.
SolveResult solve_with_tensors(const Operator& a, const at::Tensor& b, const SolveRequest& request);

/// Samples that a thread takes, such that each has some 100 µs of work at least: below that, handing it
/// over costs more than it saves. A cycle of GMRES counts as its products.
int64_t grain_size(Method method, int64_t samples, int64_t unknowns, int64_t iterations, int64_t restart);

/// u after exactly `caps` iterations of each sample, as `solver` took them on the way to its rtol, recorded
/// by autograd where b or the tensors of `a` require it: the map whose derivative the unrolled mode takes. The
/// start is a constant of that map.
struct RecordedSolve {
  at::Tensor u, operator_applications;
};
RecordedSolve solve_recorded(const Operator& a, const at::Tensor& b, const at::Tensor& x0, const Solver& solver,
                             const at::Tensor& caps);

/// The same iteration by iteration, in plain tensor operations. Of samples with caps > 0 alone.
class StepwiseSolve {
 public:
  /// What one iteration hands to the next, x first; empty: the start.
  using State = std::vector<at::Tensor>;

  StepwiseSolve(const Operator& a, const Solver& solver, const at::Tensor& b, const at::Tensor& x0,
                const at::Tensor& caps);
  /// What the iterations solve for, scaled: b, or what the start leaves of it.
  const at::Tensor& rhs() const { return rhs_; }
  /// The state after iteration `done` + 1 out of the one before it. A sample past its cap stays.
  State step(const Operator& a, const at::Tensor& rhs, const State& before, int64_t done);
  /// What x adds to u, and ū to x̄: u = start + P x / scale.
  at::Tensor scaled_back(const Operator& a, const at::Tensor& x) const { return a.project(x) / scale_; }
  /// The cotangent of b for that of rhs(): b̄ = P r̄ scale.
  at::Tensor bar_of_b(const Operator& a, const at::Tensor& rhs_bar) const { return a.project(rhs_bar) * scale_; }
  /// Undefined without one.
  const at::Tensor& start() const { return start_; }
  int64_t iterations() const;  // of the sample that takes most
  const std::vector<int64_t>& applications() const { return applications_; }

 private:
  Solver solver_;
  at::Tensor scale_, rhs_, start_;
  std::vector<double> b2_;  // of b, scaled
  std::vector<int64_t> caps_, applications_;
};

/// Which solve is reported on.
struct SolveRole {
  const OperatorSpec& a;  // the adjoint solve's is transposed
  const Solver& solver;
  bool adjoint;
  at::Tensor x0{};
};

/// Raises torch.linalg.LinAlgError, warns or does nothing about failed samples: names them, the operator, the cause
/// and the remedy (diagnosis.h).
void report_failures(const SolveRole& role, const Operator& a, const at::Tensor& b, const SolveInfo& info,
                     OnFailure on_failure);

/// While it lives, what is reported on this thread is said of this step, counted from 1, of a rollout.
class FailuresOfStep {
 public:
  FailuresOfStep(int64_t step, int64_t steps);
  FailuresOfStep(const FailuresOfStep&) = delete;
  ~FailuresOfStep();
  /// The step this thread is in and their number; 0 and 0 outside of a rollout.
  static std::pair<int64_t, int64_t> now();

 private:
  int64_t step_before_, steps_before_;
};

/// Where warnings go; torch's own by default, which prints them on stderr.
using WarningSink = void (*)(const std::string& text);
void set_warning_sink(WarningSink sink);

}  // namespace prdp
