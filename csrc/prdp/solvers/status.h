#pragma once
#include <cstdint>
#include <string>
#include <vector>

namespace prdp {

/// Why a solve stopped, one value per sample. Positive: the system is solved. The first reason wins.
enum class SolveStatus : int64_t {
  kConverged = 1,            // the true residual b - A u is <= rtol ‖b‖
  kConvergedBreakdown = 2,   // happy breakdown: the Krylov space holds the solution
  kMaxIter = -1,             // max_iter iterations done, finite, above rtol: normal life for PRDP
  kStagnated = -2,           // rtol lies below what the dtype can reach, or no progress any more
  kDiverged = -3,            // residual beyond 1e13 ‖b‖
  kOverflow = -4,            // a non-finite number arose from finite input
  kBreakdown = -5,           // no search direction left: r·Ar = 0, or a singular matrix
  kZeroDiagonal = -6,        // Jacobi on an operator with a zero on its diagonal
  kInconsistent = -7,        // b lies outside the range of a singular operator
  kNonfiniteInput = -8,      // NaN or Inf in b or in the start
  kNonfiniteOperator = -9,   // NaN or Inf in A
};

struct StatusText {
  SolveStatus status;
  const char* name;  // "MAX_ITER"
};

/// Every status with its name, in falling order of value.
const std::vector<StatusText>& solve_statuses();
const char* name(SolveStatus status);

/// A failure raises by default; MAX_ITER and STAGNATED hand out a usable iterate and do not.
inline bool is_failure(SolveStatus status) {
  return static_cast<int64_t>(status) < static_cast<int64_t>(SolveStatus::kStagnated);
}
/// Nothing was iterated: u is zero and carries no gradient.
inline bool is_refused(SolveStatus status) {
  return status == SolveStatus::kZeroDiagonal || status == SolveStatus::kNonfiniteInput ||
         status == SolveStatus::kNonfiniteOperator;
}

}  // namespace prdp
