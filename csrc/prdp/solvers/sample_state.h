#pragma once
#include <algorithm>
#include <cstdint>
#include <limits>

#include "prdp/solvers/status.h"

/// A sample while it is iterated, and what comes of it. The rules are in verdicts.h. The words of this folder:
///   settled beforehand  answered without an iteration: b = 0, numbers that are not finite, a zero on the diagonal
///   active, frozen      still iterating; the vectors of a frozen sample no longer change
///   candidate           a recursive residual has met the tolerance, and the true one is to confirm it
///   concluded           the true residual of the last iterate has been judged
///   guarded             a sample whose last iterate is of no use hands out an earlier one, or zero
///   x_bar               the cotangent of x, x̄ in comments
namespace prdp {

/// Which iterate of a sample is handed out.
enum class Returned {
  kLast,
  kBeforeBreakdown,  // the one before an iteration that broke down where nobody looked
  kBest,             // the one of least residual: b's own rounding was reached and lost again
  kBestOrZero,       // the same, or an earlier one or zero where that is better: the last ran away, or is above ‖b‖
  kZero,             // none, but zero: what is there is the rounding of a singular A
};

/// What the loop knows of one sample.
struct SampleState {
  int64_t cap = 0;         // iterations allowed
  double b2 = 0.0;         // ‖b‖²
  double enough2 = 0.0;    // a residual² at which the first cycle may end
  bool active = true;  // still iterating; a frozen sample's u no longer changes
  bool candidate = false;  // its residual has just come below rtol, to be confirmed
  bool concluded = false;  // residual2 is the true one of the last iterate, and conclude() leaves the sample alone
  bool on_its_way = false;  // to a smaller residual, it seems, when max_iter ended it
  SolveStatus status = SolveStatus::kMaxIter;
  int64_t iterations = 0;
  int64_t applications = 0;
  double residual2 = 0.0;
  int64_t looked_at = 0;  // iterations when the residual was last looked at
  double checked2 = 0.0;  // the residual then
  int64_t next_look = 0;  // iterations when it is to be looked at next
  int64_t best = 0;  // iterations after which the residual was smallest
  double best2 = std::numeric_limits<double>::infinity();
  int64_t cycles_without_progress = 0;  // for methods whose residual never grows
  double last_progress2 = std::numeric_limits<double>::infinity();  // the residual that last fell
  int64_t false_claims = 0;
  double rejected2 = std::numeric_limits<double>::infinity();  // true residual of the last false claim
  double floor2 = 0.0;  // where it stopped at rounding, the square of that: ε ‖A‖ ‖u‖, or what verdicts.h takes for it
  double rounding2 = 0.0;  // the square of how far rounding to the least numbers of its dtype may have moved b
  Returned returned = Returned::kLast;

  /// Lets the first cycle end once the estimate of its residual is a tenth of rtol ‖b‖: rounding moves it less.
  void end_cycles_at(double rtol) { enough2 = 0.01 * rtol * rtol * b2; }
  void note(double fresh2) {
    residual2 = fresh2;
    if (!(fresh2 < best2)) return;
    best2 = fresh2;
    best = iterations;
  }
  void stop(SolveStatus why) {
    status = why;
    active = false;
  }
  /// The last one changed nothing. A method may break down before the first.
  void take_back_iteration() { iterations = std::max<int64_t>(iterations - 1, 0); }
  /// Back to the start, for another pass of at most `iterations_allowed`. `best`, `returned` and `applications` stay:
  /// they are of all passes.
  void rewind(int64_t iterations_allowed) {
    cap = iterations_allowed;
    active = cap > 0;
    concluded = candidate = on_its_way = false;
    status = SolveStatus::kMaxIter;
    iterations = cycles_without_progress = next_look = false_claims = 0;
    floor2 = 0.0;
    last_progress2 = std::numeric_limits<double>::infinity();
    rejected2 = std::numeric_limits<double>::infinity();
  }
};

/// What comes of a sample.
struct SampleOutcome {
  SolveStatus status = SolveStatus::kMaxIter;
  int64_t iterations = 0, applications = 0;
  double residual = 0.0, floor = 0.0;  // relative to ‖b‖
  bool is_zero = false;  // u is zero in place of an iterate, and yet to be written
};

}  // namespace prdp
