#pragma once
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "prdp/solvers/solver.h"

namespace prdp {

/// A log of adjoint solves (adjoint_log.h), closed with its last owner.
using AdjointLog = std::shared_ptr<const int64_t>;
AdjointLog open_adjoint_log();

/// What the adjoint solves of a row of steps left in one log each, as tensors (batch, steps); nothing before
/// any. A step on which the loss does not depend had none: it counts as solved in no iterations.
std::optional<SolveInfo> join_adjoint_logs(at::IntArrayRef logs);

/// What linear_solve() takes for x0 in a step from `state`; undefined: nothing.
inline at::Tensor start_of_step(const SolveOptions& options, const at::Tensor& state) {
  return options.start == Start::kState ? state : at::Tensor();
}

/// What every stepper has: the options of its solves and their reports. Copies share the adjoint reports.
class Solving {
 public:
  /// K, the budget of the primal solve, and of the adjoint one unless it has its own.
  int64_t max_iter() const { return options_.solver.max_iter.expect_int(); }
  void set_max_iter(int64_t k);
  SolveOptions& options() { return options_; }

  /// Of the last step; nothing before the first.
  const std::optional<SolveInfo>& info() const { return info_; }
  /// Of the last adjoint solve; nothing before the first backward pass in implicit mode.
  std::optional<SolveInfo> adjoint_info() const;
  /// Whether every sample of the last step, and of its adjoint solve where there was one, met rtol.
  bool converged() const;

 protected:
  /// Raises ValueError for options out of range, in the name of `who`.
  Solving(std::string who, SolveOptions options);

  std::string who_;
  SolveOptions options_;
  std::optional<SolveInfo> info_;
  AdjointLog log_;
  std::vector<AdjointLog> logs_of_steps_;  // of the last rollout, where each step has its own
};

}  // namespace prdp
