#pragma once
#include <algorithm>
#include <cmath>

#include "prdp/solvers/space.h"
#include "prdp/solvers/verdicts.h"

/// How the loop around the methods (iterate.h) looks at residuals, and stops the samples that are done.
namespace prdp::detail {

/// GMRES in its two forms, not MINRES: each cycle takes the least residual over a space, which may be exhausted.
template <class Method>
inline constexpr bool kMayExhaust = requires(const Method& m) { m.exhausted(); };

/// Methods whose step takes several iterations: up to the next look, or all where nobody looks.
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

/// The floor ε ‖A‖ ‖u‖ of each sample: about what the rounding of a product with u leaves.
template <class Space, class Method>
auto rounding_floors(Space& space, const Method& method) {
  const auto norm_a = space.operator_norm();
  auto floors = space.values_of(space.solution2(method.x));
  for (size_t i = 0; i < floors.size(); ++i) floors[i] = space.epsilon() * norm_a[i] * std::sqrt(floors[i]);
  return floors;
}

/// How many floors a residual may be to count as rounding: 1; 8 where rtol lies below the floor, or below 8 floors for
/// direct methods, which reach no lower; 100 where a space is exhausted.
template <class Method>
double slack_of_floor(const SampleState& s, double rtol, double floor) {
  if (s.status == SolveStatus::kBreakdown) return 100.0;
  return rtol * std::sqrt(s.b2) <= (kIsExact<Method> ? 8.0 : 1.0) * floor ? 8.0 : 1.0;
}

/// The floors of the `doubtful` samples whose residual is at most slack_of_floor() of them; zero for the others. There
/// a floor above ‖b‖/4 says nothing, nor does a residual above ‖b‖/10, as u is garbage then. In float64 no floor above
/// 1e-5 ‖b‖ is taken for rounding: u is that of a singular system, which a null vector that nobody named has made
/// large.
template <class Space, class Method, class Predicate>
auto floors_of_suspects(Space& space, const Method& method, const typename Space::States& states, double rtol,
                        const Predicate& doubtful) {
  const auto all_floors = rounding_floors(space, method);
  const double largest_floor = space.epsilon() < 1e-10 ? 1e-5 : 0.25;
  auto floors = space.map(states, [](const SampleState&) { return 0.0; });
  for (size_t i = 0; i < states.size(); ++i) {
    const auto& s = states[i];
    const double floor = all_floors[i], b = std::sqrt(s.b2), residual = std::sqrt(s.residual2);
    const bool says_something = floor <= largest_floor * b && residual <= 0.1 * b;
    if (doubtful(s) && says_something && residual <= slack_of_floor<Method>(s, rtol, floor) * floor) floors[i] = floor;
  }
  return floors;
}

/// Stops those of the `doubtful` samples whose residual is rounding: near the floor ε ‖A‖ ‖u‖, as above. As the floor
/// overstates the rounding where columns of A differ in size, the residual must also be at most slack · 64 ε ‖|A| |u|‖,
/// what a product rounds, by an estimate from below. It misses the strongest coupling of two unknowns every second
/// time: more `estimates` find it. As the largest of several is less strict, they allow no slack, and a few roundings.
template <class Space, class Method, class Predicate>
PRDP_NOINLINE void stop_at_rounding_floor(Space& space, const Method& method, typename Space::States& states,
                                          double rtol, const Predicate& doubtful, int64_t estimates = 1) {
  if (std::none_of(states.begin(), states.end(), doubtful)) return;
  auto floors = floors_of_suspects(space, method, states, rtol, doubtful);
  for (int64_t p = 0; p < estimates; ++p) {
    if (std::none_of(floors.begin(), floors.end(), [](double floor) { return floor > 0.0; })) return;
    const auto componentwise_scale2 = space.values_of(space.componentwise_scale2(method.x, p));
    for (size_t i = 0; i < states.size(); ++i) {
      auto& s = states[i];
      if (!(floors[i] > 0.0)) continue;
      const double rounding = space.epsilon() * std::sqrt(componentwise_scale2[i]), residual = std::sqrt(s.residual2);
      const bool is_rounding = p == 0 ? residual <= slack_of_floor<Method>(s, rtol, floors[i]) * (64.0 * rounding)
                                      : residual <= floors[i] && residual <= 4.0 * rounding;
      if (!is_rounding) continue;
      s.stop(SolveStatus::kStagnated);
      s.floor2 = floors[i] * floors[i];
      floors[i] = 0.0;
    }
  }
}
inline constexpr int64_t kManyEstimates = 8;  // at most kSignPatterns

/// Of each sample, whether the space of a method of least residuals is exhausted; nothing for other methods.
template <class Space, class Method>
auto exhausted_of(Space& space, const Method& method) {
  if constexpr (kMayExhaust<Method>) return space.values_of(method.exhausted());
  else return 0;
}

/// Judges each active sample by the residual that the method knows. Stops what diverged, overflowed or broke down;
/// samples that seem converged go on as candidates. Returns whether there are any.
template <class Space, class Method, class Exhausted>
bool judge_known_residuals(Space& space, Method& method, typename Space::States& states, double rtol,
                           [[maybe_unused]] const Exhausted& exhausted) {
  const auto residual2 = space.values_of(method.residual2());
  const auto broken = space.broken();
  bool any_candidates = false;
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    s.candidate = false;
    if (!s.active) continue;
    s.note(residual2[i]);
    if (broken[i]) {
      s.stop(SolveStatus::kBreakdown);
      s.take_back_iteration();
      continue;
    }
    judge(s, rtol);
    if constexpr (kMayExhaust<Method>) {
      if (s.active && rtol > 0.0) judge_progress(s, exhausted[i] != 0.0);
    }
    if constexpr (kTakesStrides<Method>) plan_next_look(s, method.residual_is_log_convex(), rtol);
    if (s.status != SolveStatus::kConverged) continue;
    s.status = SolveStatus::kMaxIter;  // only a claim so far; with rtol = 0 nothing stops early
    s.active = true;
    s.candidate = rtol > 0.0;
    any_candidates = any_candidates || s.candidate;
  }
  return any_candidates;
}

/// Stops the samples whose residual is rounding though they claim nothing.
template <class Space, class Method>
void stop_stalled(Space& space, const Method& method, typename Space::States& states, double rtol) {
  // Sweeps and cycles go on at their rounding for ever, and never claim what is below it.
  if constexpr (kTakesStrides<Method> || kContracts<Method>) {
    stop_at_rounding_floor(space, method, states, rtol,
                           [rtol](const SampleState& s) { return rtol > 0.0 && !s.candidate && is_idle<Method>(s); });
  }
  if constexpr (kMayExhaust<Method>)
    stop_at_rounding_floor(space, method, states, rtol, [](const SampleState& s) {
      return s.active && !s.candidate && s.cycles_without_progress > 0;
    });
}

/// Judges the candidates by their true residual, as a recursive one may have drifted from it.
template <class Space, class Method, class Exhausted>
void confirm_candidates(Space& space, Method& method, typename Space::States& states, double rtol,
                        [[maybe_unused]] const Exhausted& exhausted) {
  space.freeze_unless(states, [](const SampleState& s) { return s.candidate; });
  const auto true_residual2 = space.values_of(method.recompute_residual());
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (!s.candidate) continue;
    s.residual2 = true_residual2[i];
    judge(s, rtol);
    if (s.active && has_drifted(s, rtol)) s.stop(SolveStatus::kStagnated);
    if constexpr (kMayExhaust<Method>) {
      if (s.status == SolveStatus::kConverged && exhausted[i] != 0.0) s.status = SolveStatus::kConvergedBreakdown;
    }
    s.rejected2 = s.residual2;
    ++s.false_claims;
  }
  stop_at_rounding_floor(space, method, states, rtol, [](const SampleState& s) { return s.candidate && s.active; });
  constexpr int64_t patience = 8;  // just above rtol, a method may claim falsely in every iteration
  const auto claims_on = [](const SampleState& s) { return s.candidate && s.active && s.false_claims > patience; };
  stop_at_rounding_floor(space, method, states, rtol, claims_on, kManyEstimates);
  for (auto& s : states)
    if (s.candidate) s.concluded = !s.active;
}

/// Looks at the residuals of the active samples, and stops those that are done or lost.
template <class Space, class Method>
PRDP_NOINLINE void observe(Space& space, Method& method, typename Space::States& states, double rtol) {
  const auto exhausted = exhausted_of(space, method);
  const bool any_candidates = judge_known_residuals(space, method, states, rtol, exhausted);
  stop_stalled(space, method, states, rtol);
  if (any_candidates) confirm_candidates(space, method, states, rtol, exhausted);
}

}  // namespace prdp::detail
