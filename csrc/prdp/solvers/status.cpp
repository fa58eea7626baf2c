#include "prdp/solvers/status.h"

#include <c10/util/Exception.h>

namespace prdp {

const std::vector<StatusText>& solve_statuses() {
  using S = SolveStatus;
  static const std::vector<StatusText> texts{
      {S::kConvergedBreakdown, "CONVERGED_BREAKDOWN", "the Krylov space holds the solution"},
      {S::kConverged, "CONVERGED", "the residual is within rtol"},
      {S::kMaxIter, "MAX_ITER", "stopped after max_iter iterations, above rtol"},
      {S::kStagnated, "STAGNATED",
       "the residual no longer falls; a larger rtol or float64 would help"},
      {S::kDiverged, "DIVERGED",
       "the residual grew without bound; this method does not converge for this operator"},
      {S::kOverflow, "OVERFLOW",
       "a number left the range of the dtype; float64 or another method would help"},
      {S::kBreakdown, "BREAKDOWN",
       "the operator is singular, or this method does not fit it"},
      {S::kZeroDiagonal, "ZERO_DIAGONAL", "this method divides by the diagonal; take another one"},
      {S::kInconsistent, "INCONSISTENT",
       "the right-hand side lies outside the range of a singular operator"},
      {S::kNonfiniteInput, "NONFINITE_INPUT", "the right-hand side, or the start, holds NaN or Inf"},
      {S::kNonfiniteOperator, "NONFINITE_OPERATOR", "the operator holds NaN or Inf"},
  };
  return texts;
}

const StatusText& describe(SolveStatus status) {
  for (const auto& text : solve_statuses())
    if (text.status == status) return text;
  TORCH_CHECK(false, "SolveStatus: no status has the value ", static_cast<int64_t>(status));
}

}  // namespace prdp
