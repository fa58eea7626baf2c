#pragma once
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "prdp/solvers/solver.h"

namespace prdp {

/// A log of adjoint solves (adjoint_log.h). It is closed when its last owner goes.
using AdjointLog = std::shared_ptr<const int64_t>;
AdjointLog open_adjoint_log();

/// The reports of the adjoint solves of consecutive steps, each with its own log, as tensors (batch, steps); nothing
/// before the first backward pass. A step that the loss does not depend on counts as solved in 0 iterations.
std::optional<SolveInfo> join_adjoint_logs(at::IntArrayRef logs);

/// The x0 of linear_solve() in a step from `state`; undefined if the solves start from zero.
inline at::Tensor start_of_step(const SolveOptions& options, const at::Tensor& state) {
  return options.start == Start::kState ? state : at::Tensor();
}

/// The base of all steppers: the options of its solves, and their reports. Copies share the adjoint reports.
class StepperBase {
 public:
  /// K >= 0 (else ValueError), for the forward solve, and for the adjoint one unless options().adjoint_max_iter is set.
  int64_t max_iter() const { return options_.solver.max_iter.expect_int(); }
  void set_max_iter(int64_t k);
  SolveOptions& options() { return options_; }
  const SolveOptions& options() const { return options_; }
  /// Its tolerance is that of a controller from now on, which tells of solves that take no iteration.
  void follow_controller() { has_controller_ = true; }

  /// The report of the last step or rollout; nothing before the first.
  const std::optional<SolveInfo>& info() const { return info_; }
  /// The report of the last backward pass; nothing before the first. Unrolled derivatives have no residual: NaN.
  std::optional<SolveInfo> adjoint_info() const;
  /// Whether all samples met the tolerance, in the last step and in its adjoint solve if there was one.
  bool converged() const;

 protected:
  /// Raises ValueError, in the name of `who`, for options out of range.
  StepperBase(std::string who, SolveOptions options);
  /// Raises ValueError unless a state is a dense tensor, and the stepper not moved from.
  void check_state(const at::Tensor& u) const;
  /// What a step or a rollout from u returns, solve(). Its report is kept; one that raises has none.
  template <class Solve>
  at::Tensor reported(const at::Tensor& u, const Solve& solve) {
    info_.reset();
    check_state(u);
    auto [next, info] = solve();
    keep(std::move(info));
    return next;
  }

  std::string who_;
  SolveOptions options_;
  std::optional<SolveInfo> info_;
  bool has_controller_ = false;
  AdjointLog log_;
  std::vector<AdjointLog> logs_of_steps_;  // of the last rollout, where each step has its own

 private:
  /// And warns of what it tells of a rollout.
  void keep(SolveInfo info);
};

}  // namespace prdp
