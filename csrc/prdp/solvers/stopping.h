#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "prdp/solvers/status.h"

/// What the loop around the methods (iterate.h) knows of a sample, and how it decides on its status.
namespace prdp {

/// What the loop knows of one sample.
struct SampleState {
  int64_t cap = 0;     // iterations allowed
  double b2 = 0.0;     // ‖b‖²
  bool active = true;  // still iterating; a frozen sample's u no longer changes
  bool claims = false; // its residual has just come below rtol, to be confirmed
  bool settled = false;  // residual2 is the true one of the returned u, and status is final
  SolveStatus status = SolveStatus::kMaxIter;
  int64_t iterations = 0;
  int64_t applications = 0;
  double residual2 = 0.0;
  int64_t looked = 0;   // iterations when the residual was last looked at; when it is to be next
  int64_t look = 0;
  double looked2 = 0.0; // the residual then
  int64_t best = 0;  // iterations after which the residual was smallest
  double best2 = std::numeric_limits<double>::infinity();
  int64_t still = 0;   // cycles since the residual last fell, for methods whose residual never grows
  double fallen2 = std::numeric_limits<double>::infinity();  // the residual then
  double refuted2 = std::numeric_limits<double>::infinity();  // true residual of the last false claim
  double floor2 = 0.0;  // where it stopped at its rounding, the square of that: ε ‖A‖ ‖u‖
  double rounding2 = 0.0;  // of b itself to the least numbers of its dtype, the square of its norm

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
  /// Back to the start, for another pass of at most `iterations_allowed`.
  void run_again(int64_t iterations_allowed) {
    cap = iterations_allowed;
    active = cap > 0;
    settled = claims = false;
    status = SolveStatus::kMaxIter;
    iterations = still = look = 0;
    floor2 = 0.0;
    fallen2 = std::numeric_limits<double>::infinity();
    refuted2 = std::numeric_limits<double>::infinity();
  }
};

inline constexpr double kDivergenceBound = 1e13;

/// Share of b in the null space that is still rounding, or of no account beside rtol.
template <class T>
T consistency_bound(double rtol) {
  return static_cast<T>(std::max(rtol, 64.0 * static_cast<double>(std::numeric_limits<T>::epsilon())));
}

/// The norm of what rounding to the least numbers of the dtype can leave in a vector of so many unknowns that was
/// multiplied by `scale`: one of them in each, as twice a half.
template <class T>
double rounding_of_least_numbers(double scale, int64_t unknowns) {
  return static_cast<double>(std::numeric_limits<T>::denorm_min()) * scale * std::sqrt(static_cast<double>(unknowns));
}

/// What A cannot reach of b, as nobody named its null space, is no failure where the rounding of b may be the cause.
inline void excuse_rounding_of_b(SampleState& s) {
  const bool failed = s.status == SolveStatus::kDiverged || s.status == SolveStatus::kBreakdown;
  if (!failed || !(s.residual2 <= s.rounding2)) return;
  s.status = SolveStatus::kStagnated;
  s.floor2 = s.residual2;
}

/// Whether of a start nothing but rounding is left once its part in the null space is taken off; by the squares of the
/// norms then and before.
template <class Number>
auto leaves_rounding(const Number& left2, const Number& whole2, double epsilon) {
  return left2 <= whole2 * (64.0 * epsilon * (64.0 * epsilon));
}
/// Whether what a start takes off b, by the squares of the norms before and then, is more than the rounding of its
/// product, ε ‖A‖ ‖x‖: a start that A maps to zero, or nearly so, is large and worse than none.
template <class Number>
auto outdoes_rounding(const Number& b2, const Number& left2, const Number& rounding) {
  using std::sqrt;
  return sqrt(b2) - sqrt(left2) > 4.0 * rounding;
}

/// Where u, of this largest entry, consists of the smallest numbers of its dtype, its residual is their rounding.
template <class T>
void note_underflow(SampleState& s, double largest) {
  if (largest >= std::numeric_limits<T>::min()) return;
  const double lost = largest == 0.0 ? 1.0 : std::numeric_limits<T>::denorm_min() / largest;
  if (s.residual2 >= lost * lost * s.b2) return;
  s.residual2 = s.floor2 = lost * lost * s.b2;
  if (static_cast<int64_t>(s.status) > 0) s.status = SolveStatus::kStagnated;
}

namespace detail {

/// GMRES and its like: each iteration takes the least residual over a space, which may be exhausted.
template <class Method>
inline constexpr bool kLeastResidual = requires(const Method& m) { m.exhausted(); };

/// Methods that may say how their residual falls, and then take several iterations in one step.
template <class Method>
inline constexpr bool kTakesStrides = requires(Method& m, int64_t n) { m.step(n); };

/// Methods that update their residual by a recursion, and go on from the true one once it is recomputed.
template <class Method>
inline constexpr bool kHasRecursiveResidual = requires { Method::kHasRecursiveResidual; };

/// Methods for definite operators: a truncated iterate may have a residual above ‖b‖ and still be nearer to the
/// solution than zero, in the norm of A.
template <class Method>
inline constexpr bool kDescendsEnergy = requires { Method::kDescendsEnergy; };

/// Methods whose one iteration solves.
template <class Method>
inline constexpr bool kIsExact = requires { Method::kIsExact; };

/// Methods whose every iteration takes about the same share off the error.
template <class Method>
inline constexpr bool kContracts = requires { Method::kContracts; };

/// Sweeps or cycles without progress for so long may be at their rounding, which takes a closer look.
template <class Method>
bool is_idle(const SampleState& s) {
  constexpr int64_t patience = kContracts<Method> ? 2 : 128;
  return (kTakesStrides<Method> || kContracts<Method>) && s.active && s.iterations - s.best > patience;
}

/// Whether a residual asks to be confirmed by the true one.
inline bool is_within(double residual2, double rtol, double b2) { return residual2 <= rtol * rtol * b2; }

/// The iterates have run away: the last one is of no use.
inline bool lost(const SampleState& s) {
  return s.status == SolveStatus::kOverflow || s.status == SolveStatus::kDiverged;
}

/// It had come to the rounding of b and went on, and has lost that again.
inline bool left_rounding_of_b(const SampleState& s) {
  return s.best2 > 0.0 && s.best2 <= s.rounding2 && s.residual2 > 4.0 * s.rounding2;
}

/// The true residual no longer follows the method's own: a second false claim, after the method has
/// gone on from the true residual of the first, has not even halved it. Just above rtol that is noise.
inline bool parted_ways(const SampleState& s, double rtol) {
  return s.residual2 > 0.25 * s.refuted2 && s.residual2 > 2.25 * rtol * rtol * s.b2;
}

/// Statuses that follow from a true residual. `rtol` = 0 asks for an exact zero.
inline void judge(SampleState& s, double rtol) {
  if (!std::isfinite(s.residual2)) return s.stop(SolveStatus::kOverflow);
  if (s.residual2 > kDivergenceBound * kDivergenceBound * s.b2) return s.stop(SolveStatus::kDiverged);
  if (is_within(s.residual2, rtol, s.b2)) s.stop(SolveStatus::kConverged);
}

/// A method of least residuals that no longer moves: a breakdown where its space is exhausted, and
/// stagnation where several cycles in a row have not taken a thousandth off the residual.
inline void judge_progress(SampleState& s, bool exhausted) {
  constexpr double progress2 = 0.998;
  constexpr int64_t patience = 10;
  if (s.residual2 < progress2 * s.fallen2) {
    s.fallen2 = s.residual2;
    s.still = 0;
    return;
  }
  if (exhausted) {
    --s.iterations;  // this one changed nothing
    return s.stop(SolveStatus::kBreakdown);
  }
  if (++s.still >= patience) s.stop(SolveStatus::kStagnated);
}

/// Stops those of the `doubtful` samples whose residual is rounding, floor = ε ‖A‖ ‖u‖: one that is no larger, or up to
/// eight times as large where rtol lies below the floor. An exhausted space is judged with more slack. A floor near ‖b‖
/// says nothing: there u is garbage. Nor does one far above ε ‖|A| |u|‖, which is what a product rounds: columns of A
/// that differ much in size make ‖A‖ ‖u‖ large without.
template <class Space, class Method, class Predicate>
void stop_at_rounding_floor(Space& space, const Method& method, typename Space::States& states, double rtol,
                            const Predicate& doubtful) {
  if (std::none_of(states.begin(), states.end(), doubtful)) return;
  const auto norm_a = space.operator_norm();
  const auto u2 = space.lanes(space.solution2(method.x));
  const auto slack_of = [&](const SampleState& s, double floor) {
    return s.status == SolveStatus::kBreakdown ? 100.0 : rtol * std::sqrt(s.b2) <= floor ? 8.0 : 1.0;
  };
  auto floors = space.map(states, [](const SampleState&) { return 0.0; });
  for (size_t i = 0; i < states.size(); ++i) {
    const auto& s = states[i];
    const double floor = space.epsilon() * norm_a[i] * std::sqrt(u2[i]), b = std::sqrt(s.b2);
    if (doubtful(s) && floor <= 0.25 * b && std::sqrt(s.residual2) <= slack_of(s, floor) * floor) floors[i] = floor;
  }
  if (std::none_of(floors.begin(), floors.end(), [](double floor) { return floor > 0.0; })) return;
  constexpr double far = 64.0;
  const auto terms2 = space.lanes(space.terms2(method.x));
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    const double of_product = far * space.epsilon() * std::sqrt(terms2[i]);
    if (!(floors[i] > 0.0) || !(std::sqrt(s.residual2) <= slack_of(s, floors[i]) * of_product)) continue;
    s.stop(SolveStatus::kStagnated);
    s.floor2 = floors[i] * floors[i];
  }
}

/// Sets when the residual is to be looked at next. Where it is log-convex it falls no faster from here
/// on than it did since the last look, and cannot come below rtol before that; twice rtol leaves room
/// for rounding.
inline void plan_next_look(SampleState& s, bool log_convex, double rtol) {
  constexpr double longest = 64.0;
  double stride = 1.0;
  if (log_convex && rtol > 0.0 && s.iterations > 0 && s.residual2 > 4.0 * rtol * rtol * s.b2) {
    const double fall = std::log(s.residual2 / s.looked2) / static_cast<double>(s.iterations - s.looked);
    const double to_go = std::log(4.0 * rtol * rtol * s.b2 / s.residual2);
    stride = fall < 0.0 ? std::min(std::ceil(to_go / fall), longest) : longest;
  }
  s.looked = s.iterations;
  s.looked2 = s.residual2;
  s.look = s.iterations + static_cast<int64_t>(stride);
}

/// Takes the residuals that the method knows. Freezes what diverged, overflowed or broke down, and
/// confirms what seems converged by the true residual: a recursive one may have drifted from it.
template <class Space, class Method>
void observe(Space& space, Method& method, typename Space::States& states, double rtol) {
  const auto residual2 = space.lanes(method.residual2());
  const auto broken = space.broken();
  [[maybe_unused]] decltype(space.lanes(method.residual2())) exhausted{};
  if constexpr (kLeastResidual<Method>) exhausted = space.lanes(method.exhausted());
  bool any_claims = false;
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    s.claims = false;
    if (!s.active) continue;
    s.note(residual2[i]);
    if (broken[i]) {
      s.stop(SolveStatus::kBreakdown);
      --s.iterations;  // the one that broke down changed nothing
      continue;
    }
    judge(s, rtol);
    if constexpr (kLeastResidual<Method>) {
      if (s.active && rtol > 0.0) judge_progress(s, exhausted[i] != 0.0);
    }
    if constexpr (kTakesStrides<Method>) plan_next_look(s, method.residual_is_log_convex(), rtol);
    if (s.status != SolveStatus::kConverged) continue;
    s.status = SolveStatus::kMaxIter;  // only a claim so far; with rtol = 0 nothing stops early
    s.active = true;
    s.claims = rtol > 0.0;
    any_claims = any_claims || s.claims;
  }
  // Sweeps and cycles go on at their rounding for ever, and never claim what is below it.
  if constexpr (kTakesStrides<Method> || kContracts<Method>) {
    stop_at_rounding_floor(space, method, states, rtol,
                           [rtol](const SampleState& s) { return rtol > 0.0 && !s.claims && is_idle<Method>(s); });
  }
  if constexpr (kLeastResidual<Method>)
    stop_at_rounding_floor(space, method, states, rtol,
                           [](const SampleState& s) { return s.active && !s.claims && s.still > 0; });
  if (!any_claims) return;

  space.freeze_unless(states, [](const SampleState& s) { return s.claims; });
  const auto true2 = space.lanes(method.recompute_residual());
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (!s.claims) continue;
    s.residual2 = true2[i];
    judge(s, rtol);
    if (s.active && parted_ways(s, rtol)) s.stop(SolveStatus::kStagnated);
    if constexpr (kLeastResidual<Method>) {
      if (s.status == SolveStatus::kConverged && exhausted[i] != 0.0) s.status = SolveStatus::kConvergedBreakdown;
    }
    s.refuted2 = s.residual2;
  }
  stop_at_rounding_floor(space, method, states, rtol, [](const SampleState& s) { return s.claims && s.active; });
  for (auto& s : states)
    if (s.claims) s.settled = !s.active;
}

}  // namespace detail

}  // namespace prdp
