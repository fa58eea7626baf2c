#pragma once
#include <cstdint>
#include <string>
#include <vector>

namespace prdp {

/// Why the solve of a sample stopped. Positive: the system is solved. Of several reasons, the first one is reported.
enum class SolveStatus : int64_t {
  kConverged = 1,            // the recomputed residual satisfies ‖b - A u‖ <= rtol ‖b‖
  kConvergedBreakdown = 2,   // the Krylov space contains the solution
  kMaxIter = -1,             // max_iter iterations were done; u is finite. PRDP stops here by design
  kStagnated = -2,           // no further progress, for example because the dtype cannot reach rtol
  kDiverged = -3,            // residual above 1e13 ‖b‖, or ‖b‖ by CG, steepest descent; of a flow: dt too long
  kOverflow = -4,            // finite input gave a number outside the range of the dtype
  kBreakdown = -5,           // the method cannot continue: r·Ar = 0, or a singular matrix
  kZeroDiagonal = -6,        // the method divides by the diagonal, which has a zero
  kInconsistent = -7,        // A is singular, and b is not in its range
  kNonfiniteInput = -8,      // NaN or Inf in b or in the start
  kNonfiniteOperator = -9,   // NaN or Inf in A
};

struct StatusText {
  SolveStatus status;
  const char* name;  // "MAX_ITER"
};

/// All statuses with their names, from the largest value to the smallest.
const std::vector<StatusText>& solve_statuses();
const char* name(SolveStatus status);

inline bool is_solved(SolveStatus status) { return static_cast<int64_t>(status) > 0; }
/// Whether the sample failed, which raises an error by default. After MAX_ITER and STAGNATED the iterate is usable.
inline bool is_failure(SolveStatus status) {
  return static_cast<int64_t>(status) < static_cast<int64_t>(SolveStatus::kStagnated);
}
/// Whether the iterations ended with a usable iterate and no solution.
inline bool is_unsolved(SolveStatus status) {
  return status == SolveStatus::kMaxIter || status == SolveStatus::kStagnated;
}
/// Whether the input was refused before any iteration: u is zero and carries no gradient.
inline bool is_refused(SolveStatus status) {
  return status == SolveStatus::kZeroDiagonal || status == SolveStatus::kNonfiniteInput ||
         status == SolveStatus::kNonfiniteOperator;
}

}  // namespace prdp
