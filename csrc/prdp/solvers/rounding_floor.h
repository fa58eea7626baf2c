#pragma once
#include <algorithm>
#include <cmath>

#include "prdp/solvers/method_properties.h"
#include "prdp/solvers/sample_state.h"
#include "prdp/solvers/space.h"

/// When a residual is no more than rounding, so that its sample gets no better.
namespace prdp::detail {

/// The floor ε ‖A‖ ‖u‖ of each sample: about what the rounding of a product with u leaves.
template <class Space, class Method>
auto rounding_floors(Space& space, const Method& method) {
  const auto norm_a = space.operator_norm();
  auto floors = space.values_of(space.solution2(method.x));
  for (size_t i = 0; i < floors.size(); ++i) floors[i] = space.unit_roundoff() * norm_a[i] * std::sqrt(floors[i]);
  return floors;
}

/// A floor beyond this share of ‖b‖ means that u has grown along a null vector that nobody named, or nearly one.
template <class Space>
double largest_floor(const Space& space) {
  return space.unit_roundoff() < 1e-10 ? 1e-5 : 0.25;
}

/// Sweeps or cycles without progress for so long may be at their rounding, which takes a closer look.
template <class Method>
bool is_idle(const SampleState& s) {
  constexpr int64_t patience = kContracts<Method> ? 2 : 128;
  return (kTakesStrides<Method> || kContracts<Method>) && s.iterations - s.best > patience;
}

/// Whether a sample that max_iter ended seems to have gained to the last. `known2` is the residual² that the method
/// knew; residual2 is the true one.
template <class Method>
bool seems_on_its_way(const SampleState& s, double known2) {
  if (kIsExact<Method> || s.iterations == 0) return false;
  // A recursive residual falls on where the true one does not. After a false claim it starts from the true one again.
  if (kHasRecursiveResidual<Method>) return s.false_claims == 0 && s.residual2 <= 4.0 * known2;
  return s.best == s.iterations;
}

/// How many floors a residual may be to count as rounding: 1; 8 where rtol lies below the floor and the sample does not
/// seem on its way, or nothing is gained any more; 32 for direct methods where rtol lies below that, as their sums are
/// long; 100 where a space is exhausted.
template <class Method>
double slack_of_floor(const SampleState& s, double rtol, double floor) {
  if (s.status == SolveStatus::kBreakdown) return 100.0;
  if (s.on_its_way) return 1.0;
  const double target = rtol * std::sqrt(s.b2);
  if (kIsExact<Method>) return target <= 32.0 * floor ? 32.0 : 1.0;
  const bool gains_nothing = !kOscillates<Method> && is_idle<Method>(s);
  return target <= floor || gains_nothing ? 8.0 : 1.0;
}

/// The floor of each `doubtful` sample whose residual is at most slack_of_floor() floors; 0 for the others. Never of a
/// residual above ‖b‖/10, as u is garbage then, nor a floor above largest_floor().
template <class Space, class Method, class Predicate>
auto floors_of_suspects(Space& space, const Method& method, const typename Space::States& states, double rtol,
                        const Predicate& doubtful) {
  const auto all_floors = rounding_floors(space, method);
  auto floors = space.map(states, [](const SampleState&) { return 0.0; });
  for (size_t i = 0; i < states.size(); ++i) {
    const auto& s = states[i];
    const double floor = all_floors[i], b = std::sqrt(s.b2), residual = std::sqrt(s.residual2);
    const bool is_plausible = floor <= largest_floor(space) * b && residual <= 0.1 * b;
    if (doubtful(s) && is_plausible && residual <= slack_of_floor<Method>(s, rtol, floor) * floor) floors[i] = floor;
  }
  return floors;
}

// What a product may round, in estimates of ε ‖|A| |u|‖: by the first estimate, by the largest of several, and where a
// sample seems on its way, which is then no further off than u is rounded.
inline constexpr double kRoundingsOfProduct = 64.0, kFewRoundings = 4.0, kRoundingsOnItsWay = 2.0;
inline constexpr int64_t kManyEstimates = 8;  // at most kSignPatterns

/// Whether a suspect's residual is rounding, by this attempt at an estimate of ε ‖|A| |u|‖. The first allows slack and
/// many roundings. The others allow no slack and few roundings, as one sample then has several chances to pass. One
/// that seems on its way has one chance, without slack.
template <class Method>
bool residual_is_rounding(const SampleState& s, double rtol, double floor, double rounding, int64_t attempt) {
  const double residual = std::sqrt(s.residual2);
  if (attempt == 0 && !s.on_its_way)
    return residual <= slack_of_floor<Method>(s, rtol, floor) * (kRoundingsOfProduct * rounding);
  return residual <= floor && residual <= (s.on_its_way ? kRoundingsOnItsWay : kFewRoundings) * rounding;
}

/// Stops the `doubtful` samples whose residual is rounding: a few floors ε ‖A‖ ‖u‖ at most, and of the order of
/// ε ‖|A| |u|‖, what a product rounds. The floor alone overstates that where columns of A differ in size. ‖|A| |u|‖ is
/// estimated from below with random signs. One estimate in two misses the strongest coupling of two unknowns, so that
/// there may be several `estimates`.
template <class Space, class Method, class Predicate>
PRDP_NOINLINE void stop_at_rounding_floor(Space& space, const Method& method, typename Space::States& states,
                                          double rtol, const Predicate& doubtful, int64_t estimates = 1) {
  if (std::none_of(states.begin(), states.end(), doubtful)) return;
  auto suspected = floors_of_suspects(space, method, states, rtol, doubtful);  // 0: not suspected
  for (int64_t attempt = 0; attempt < estimates; ++attempt) {
    if (std::none_of(suspected.begin(), suspected.end(), [](double floor) { return floor > 0.0; })) return;
    const auto componentwise_scale2 = space.values_of(space.componentwise_scale2(method.x, attempt));
    for (size_t i = 0; i < states.size(); ++i) {
      auto& s = states[i];
      const double floor = suspected[i], rounding = space.unit_roundoff() * std::sqrt(componentwise_scale2[i]);
      if (!(floor > 0.0)) continue;
      const bool is_rounding = residual_is_rounding<Method>(s, rtol, floor, rounding, attempt);
      if (is_rounding || s.on_its_way) suspected[i] = 0.0;
      if (!is_rounding) continue;
      s.stop(SolveStatus::kStagnated);
      s.floor2 = floor * floor;
    }
  }
}

}  // namespace prdp::detail
