#pragma once
#include <functional>

#include "prdp/operators/operator.h"
#include "prdp/solvers/solver.h"

/// Solves that autograd records: the unrolled mode differentiates them.
namespace prdp {

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

}  // namespace prdp
