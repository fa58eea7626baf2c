#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "prdp/solvers/sample_state.h"

/// What may happen to a sample: each rule that gives it a status, in the CPU loops, in tensors and in kernels of GPUs.
/// What takes products to tell is in observe.h, rounding_floor.h, energy.h, iterate.h and unnamed_null_space.cpp; what
/// is settled before the first iteration, as NaN in b, in solve_sample.h and prepared_batch.cpp. A `Flow` refuses
/// samples before it solves (steppers/flow/limits.cpp, gpu/device/flow.h).
namespace prdp {

// ---- while it is iterated

inline constexpr double kDivergenceBound = 1e13;

/// Whether ‖r‖ <= rtol ‖b‖, from their squares.
inline bool is_within(double residual2, double rtol, double b2) { return residual2 <= rtol * rtol * b2; }

/// Statuses that follow from a residual; from a recursive one, kConverged is only a claim, which observe() confirms.
/// `rtol` = 0 asks for an exact zero.
inline void judge(SampleState& s, double rtol) {
  if (!std::isfinite(s.residual2)) return s.stop(SolveStatus::kOverflow);
  if (s.residual2 > kDivergenceBound * kDivergenceBound * s.b2) return s.stop(SolveStatus::kDiverged);
  if (is_within(s.residual2, rtol, s.b2)) s.stop(SolveStatus::kConverged);
}

/// The true residual no longer follows the method's own: a second false claim, after the method has
/// gone on from the true residual of the first, has not even halved it. Just above rtol that is noise.
inline bool has_drifted(const SampleState& s, double rtol) {
  return s.residual2 > 0.25 * s.rejected2 && s.residual2 > 2.25 * rtol * rtol * s.b2;
}

/// GMRES that no longer moves: a breakdown where its space is exhausted, and
/// stagnation where several cycles in a row have not taken a thousandth off the residual.
inline void judge_progress(SampleState& s, bool exhausted) {
  constexpr double progress2 = 0.998;
  constexpr int64_t patience = 10;
  if (s.residual2 < progress2 * s.last_progress2) {
    s.last_progress2 = s.residual2;
    s.cycles_without_progress = 0;
    return;
  }
  if (exhausted) {
    s.take_back_iteration();
    return s.stop(SolveStatus::kBreakdown);
  }
  if (++s.cycles_without_progress >= patience) s.stop(SolveStatus::kStagnated);
}

/// Sets when the residual is to be looked at next. Where it is log-convex it falls no faster from here
/// on than it did since the last look, and cannot come below rtol before that; twice rtol leaves room
/// for rounding.
inline void plan_next_look(SampleState& s, bool log_convex, double rtol) {
  constexpr double longest = 64.0;
  double stride = 1.0;
  if (log_convex && rtol > 0.0 && s.iterations > 0 && s.residual2 > 4.0 * rtol * rtol * s.b2) {
    const double fall = std::log(s.residual2 / s.checked2) / static_cast<double>(s.iterations - s.looked_at);
    const double to_go = std::log(4.0 * rtol * rtol * s.b2 / s.residual2);
    stride = fall < 0.0 ? std::min(std::ceil(to_go / fall), longest) : longest;
  }
  s.looked_at = s.iterations;
  s.checked2 = s.residual2;
  s.next_look = s.iterations + static_cast<int64_t>(stride);
}

// ---- its last iterate

/// The iterates have run away: the last one is of no use.
inline bool ran_away(const SampleState& s) {
  return s.status == SolveStatus::kOverflow || s.status == SolveStatus::kDiverged;
}

/// It had come to the rounding of b and went on, and has lost that again.
inline bool left_rounding_of_b(const SampleState& s) {
  return s.best2 > 0.0 && s.best2 <= s.rounding2 && s.residual2 > 4.0 * s.rounding2;
}

/// It went on and got worse: of a direct method, whose first solve is the most accurate where refining adds rounding.
inline bool was_better(const SampleState& s) { return s.best > 0 && s.best < s.iterations && s.residual2 > s.best2; }

/// The residual is above ‖b‖/100.
inline bool is_far_from_solved(const SampleState& s) { return s.residual2 > 1e-4 * s.b2; }

/// The residual is above ‖b‖: zero would be a better answer.
inline bool is_above_b(const SampleState& s, double epsilon) { return s.residual2 > (1.0 + 256.0 * epsilon) * s.b2; }

// ---- the limits of the dtype

/// Share of b in the null space that is still rounding, or of no account beside rtol. In float64, 1e-10 is what a mean
/// 1e5 times the size of b leaves where it is taken off.
template <class T>
T consistency_bound(double rtol) {
  constexpr double rounding = std::max(1e-10, 64.0 * static_cast<double>(std::numeric_limits<T>::epsilon()));
  return static_cast<T>(std::max(rtol, rounding));
}

/// How far, in norm, rounding to denormal numbers may have moved a vector of so many unknowns that was then multiplied
/// by `scale`: half a denorm_min for each entry, doubled.
template <class T>
double subnormal_rounding(double scale, int64_t unknowns) {
  return static_cast<double>(std::numeric_limits<T>::denorm_min()) * scale * std::sqrt(static_cast<double>(unknowns));
}

/// Whether a start is rounding alone once its part in the null space is taken off. Squared norms: after, before.
template <class Number>
auto only_rounding_is_left(const Number& left2, const Number& whole2, double epsilon) {
  return left2 <= whole2 * (64.0 * epsilon * (64.0 * epsilon));
}

/// Whether what a start takes off b, by b2 = ‖b‖² and left2 = ‖b - A x‖², is more than the rounding of its product,
/// ε ‖A‖ ‖x‖: a start that A maps to zero, or nearly so, is large and worse than none.
template <class Number>
auto start_gains_more_than_rounding(const Number& b2, const Number& left2, const Number& rounding) {
  using std::sqrt;
  return sqrt(b2) - sqrt(left2) > 4.0 * rounding;
}

/// A DIVERGED or BREAKDOWN whose residual is no more than the rounding of b is excused: but for that rounding, b may
/// lie in the range of A.
inline void excuse_rounding_of_b(SampleState& s) {
  const bool failed = s.status == SolveStatus::kDiverged || s.status == SolveStatus::kBreakdown;
  if (!failed || !(s.residual2 <= s.rounding2)) return;
  s.status = SolveStatus::kStagnated;
  s.floor2 = s.residual2;
}

/// Where u, of this largest entry, consists of the smallest numbers of its dtype, its residual is their rounding.
template <class T>
void note_underflow(SampleState& s, double largest) {
  const double lost = largest == 0.0 ? 1.0 : std::numeric_limits<T>::denorm_min() / largest;
  if (s.residual2 >= lost * lost * s.b2) return;
  s.residual2 = s.floor2 = lost * lost * s.b2;
  if (is_solved(s.status)) s.status = SolveStatus::kStagnated;
}

// ---- its end

/// Of a sample that gets no iteration, or whose iterates are of no use: u = 0.
inline SampleOutcome zero_instead(SolveStatus status, int64_t applications = 0) {
  const bool is_nonfinite = status == SolveStatus::kNonfiniteInput || status == SolveStatus::kNonfiniteOperator;
  const double residual = is_nonfinite                        ? std::numeric_limits<double>::infinity()
                          : status == SolveStatus::kConverged ? 0.0
                                                              : 1.0;
  return {status, 0, applications, residual, status == SolveStatus::kStagnated ? residual : 0.0, true};
}

/// Of a sample whose iterations are over. `consistent`: b lies in the range of A; `largest` number of u, which is not
/// finite if it leaves the range of T; `is_nonzero()`: whether u had digits before it was scaled back.
template <class T, class IsNonzero>
SampleOutcome outcome_of(SampleState& s, bool guarded, bool consistent, double largest, const IsNonzero& is_nonzero) {
  if (guarded) excuse_rounding_of_b(s);
  if (!consistent && !is_failure(s.status)) s.status = SolveStatus::kInconsistent;
  if (guarded && !std::isfinite(largest)) return zero_instead(SolveStatus::kOverflow, s.applications);
  if (largest < std::numeric_limits<T>::min() && is_nonzero()) note_underflow<T>(s, largest);
  const double floor = is_failure(s.status) ? 0.0 : std::sqrt(s.floor2 / s.b2);
  return {s.status, s.iterations, s.applications, std::sqrt(s.residual2 / s.b2), floor};
}

}  // namespace prdp
