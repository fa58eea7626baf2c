#include "prdp/solvers/status.h"

#include <c10/util/Exception.h>

namespace prdp {

const std::vector<StatusText>& solve_statuses() {
  using S = SolveStatus;
  static const std::vector<StatusText> texts{
      {S::kConvergedBreakdown, "CONVERGED_BREAKDOWN"},
      {S::kConverged, "CONVERGED"},
      {S::kMaxIter, "MAX_ITER"},
      {S::kStagnated, "STAGNATED"},
      {S::kDiverged, "DIVERGED"},
      {S::kOverflow, "OVERFLOW"},
      {S::kBreakdown, "BREAKDOWN"},
      {S::kZeroDiagonal, "ZERO_DIAGONAL"},
      {S::kInconsistent, "INCONSISTENT"},
      {S::kNonfiniteInput, "NONFINITE_INPUT"},
      {S::kNonfiniteOperator, "NONFINITE_OPERATOR"},
  };
  return texts;
}

const char* name(SolveStatus status) {
  for (const auto& text : solve_statuses())
    if (text.status == status) return text.name;
  TORCH_CHECK(false, "SolveStatus: no status has the value ", static_cast<int64_t>(status));
}

}  // namespace prdp
