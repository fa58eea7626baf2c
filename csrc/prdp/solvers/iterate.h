#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "prdp/solvers/energy.h"
#include "prdp/solvers/observe.h"
#include "prdp/solvers/space.h"

/// The one loop around every method: it counts, checks and decides, per sample. A method (jacobi.h,
/// …) supplies one iteration; a space (space.h) says what a vector is. All spaces run these same lines.
namespace prdp {

namespace detail {

/// Iterations until one of the samples comes to its end or, with `track`, is to be looked at.
template <class States>
int64_t stride(const States& states, bool track) {
  int64_t n = std::numeric_limits<int64_t>::max();
  for (const auto& s : states)
    if (s.active) n = std::min(n, (track ? std::min(s.cap, s.next_look) : s.cap) - s.iterations);
  return n;
}

/// Runs each active sample for at most `cap` iterations. `track`: residuals are judged on the way, at each planned
/// look; without it, as for rtol = 0, nothing is judged before conclude().
template <class Space, class Method>
PRDP_NOINLINE void run(Space& space, Method& method, typename Space::States& states, double rtol, bool track) {
  method.start();
  if (track) observe(space, method, states, rtol);
  for (;;) {
    bool any_active = false;
    for (auto& s : states) {
      if (s.iterations >= s.cap) s.active = false;
      any_active = any_active || s.active;
    }
    if (!any_active) return;
    space.freeze_unless(states, [](const SampleState& s) { return s.active; });
    int64_t n = 1;
    if constexpr (kTakesStrides<Method>) {
      n = stride(states, track);
      method.step(n);
    } else {
      method.step();
    }
    for (auto& s : states) s.iterations += s.active ? n : 0;
    if (track) observe(space, method, states, rtol);
  }
}

/// Iteration `done` + 1, to be differentiated, as run() took it. `confirm()` looks for samples whose recursive residual
/// has met the tolerance, and recomputes theirs: from the true one they go on.
template <class Method, class Confirm>
void repeat_iteration(Method& method, double rtol, int64_t done, const Confirm& confirm) {
  if constexpr (kHasRecursiveResidual<Method>)
    if (rtol > 0.0 && done > 0) confirm();
  if constexpr (kTakesStrides<Method>) method.step(1);
  else method.step();
  if constexpr (kMayExhaust<Method>) method.residual2();  // undoes a cycle that made the residual grow
}

/// Recomputes the residual of each sample that is not concluded, and sets its status.
template <class Space, class Method>
PRDP_NOINLINE void conclude(Space& space, Method& method, typename Space::States& states, double rtol) {
  const auto open = [](const SampleState& s) { return !s.concluded; };
  if (std::none_of(states.begin(), states.end(), open)) return;
  space.freeze_unless(states, open);
  const auto exhausted = exhausted_of(space, method);
  const auto residual2 = space.values_of(method.recompute_residual());
  const auto broken = space.broken();
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (s.concluded) continue;
    const double known2 = s.residual2;
    s.residual2 = residual2[i];
    if (broken[i]) s.status = SolveStatus::kBreakdown;
    if (!ran_away(s)) judge(s, rtol);
    s.on_its_way =
        s.status == SolveStatus::kMaxIter && seems_on_its_way<Method>(s, known2) && !is_exhausted<Method>(exhausted, i);
  }
  const auto doubtful = [rtol](const SampleState& s) {
    const bool unsolved =
        s.status == SolveStatus::kMaxIter || (kMayExhaust<Method> && s.status == SolveStatus::kBreakdown);
    return rtol > 0.0 && !s.concluded && unsolved;
  };
  stop_at_rounding_floor(space, method, states, rtol, doubtful, kManyEstimates);
  for (auto& s : states) {
    s.active = false;
    s.concluded = true;
  }
}

/// Of a sample that ended above ‖b‖: where A is definite for sure, and the residual is the rounding of a product, the
/// last iterate is as good as the dtype allows.
template <class Space, class Method>
void accept_at_rounding_floor(Space& space, const Method& method, typename Space::States& states) {
  const auto is_doubted = [](const SampleState& s) { return s.returned != Returned::kLast; };
  if (std::none_of(states.begin(), states.end(), is_doubted)) return;
  const auto definite = space.surely_definite();
  const auto floors = rounding_floors(space, method);
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (is_doubted(s) && definite[i] && s.residual2 <= 64.0 * floors[i] * floors[i]) s.returned = Returned::kLast;
  }
}

/// Hands out the last iterate: its residual is rounding.
inline void accept_rounding(SampleState& s) {
  s.returned = Returned::kLast;
  s.status = SolveStatus::kStagnated;
  s.floor2 = s.residual2;
}

/// Of the samples that return zero, accepts those whose u the rounding of A moves by less than a thousandth.
template <class Space, class Method>
void accept_if_insensitive(Space& space, const Method& method, typename Space::States& states) {
  constexpr double stays = 1e-3;  // far below 1, as the estimate may be too small
  const auto u2 = space.values_of(space.solution2(method.x)), moved2 = space.values_of(space.skeel_estimate2(method.x));
  for (size_t i = 0; i < states.size(); ++i)
    if (states[i].returned == Returned::kZero &&
        space.unit_roundoff() * std::sqrt(moved2[i]) < stays * std::sqrt(u2[i]))
      accept_rounding(states[i]);
}

/// For direct methods, where the rounding ε ‖A‖ ‖u‖ is of the order of ‖b‖. If the factors are those of a definite A, u
/// is as good as the dtype allows, and its residual is rounding. Else, where that exceeds 1e-2 ‖b‖ and the rounding of
/// A may move u, A is singular to the dtype, and zero replaces u. Any other residual above ‖b‖ is a breakdown.
template <class Space, class Method>
void judge_numerical_singularity(Space& space, const Method& method, typename Space::States& states, bool track) {
  const auto is_large = [](const SampleState& s) { return is_unsolved(s.status) && is_far_from_solved(s); };
  const auto is_doubtful = [&](const SampleState& s) {
    return is_large(s) || (track && s.status == SolveStatus::kMaxIter);
  };
  if (!std::none_of(states.begin(), states.end(), is_doubtful)) {  // kernels have no any_of
    const auto floors = rounding_floors(space, method);
    const auto definite = space.definite_factors(method.x);
    bool asks_for_estimate = false;
    for (size_t i = 0; i < states.size(); ++i) {
      auto& s = states[i];
      if (!is_doubtful(s) || !(floors[i] > 0.25 * std::sqrt(s.b2))) continue;
      if (definite[i]) accept_rounding(s);
      else if (is_large(s)) s.returned = Returned::kZero;
      asks_for_estimate = asks_for_estimate || s.returned == Returned::kZero;
    }
    if (asks_for_estimate) accept_if_insensitive(space, method, states);
  }
  for (auto& s : states)
    if (s.returned != Returned::kLast) s.status = SolveStatus::kBreakdown;
}

/// Methods whose u may grow along a null vector of A that nobody named: those for any A, or any symmetric one.
template <class Method>
inline constexpr bool kMayGrow = kMayExhaust<Method> || (kHasRecursiveResidual<Method> && !kDescendsEnergy<Method>);

/// Which samples have a u that has grown: they are far from solved, and the rounding of A u, ε ‖|A| |u|‖, is large
/// beside b. It is estimated with random signs, as ε ‖A‖ ‖u‖ is large wherever A has a penalty term. In float32 no u
/// counts as grown: near a null space every u is that large, and it may be the best there is.
template <class Space, class Method>
auto have_grown(Space& space, const Method& method, const typename Space::States& states) {
  auto grown = space.map(states, [](const SampleState&) { return false; });
  if (space.unit_roundoff() > 1e-10) return grown;
  const auto floors = rounding_floors(space, method);
  const auto definite = space.surely_definite();
  // In a badly conditioned system a method other than GMRES may still be on its way: its bound is 100 times as large.
  const double bound = largest_floor(space) * (kMayExhaust<Method> ? 1.0 : 100.0);
  bool any = false;
  for (size_t i = 0; i < states.size(); ++i) {
    const auto& s = states[i];
    grown[i] = !definite[i] && s.floor2 == 0.0 && is_far_from_solved(s) && floors[i] > bound * std::sqrt(s.b2);
    any = any || grown[i];
  }
  if (!any) return grown;
  const auto rounding2 = space.values_of(space.componentwise_scale2(method.x, /*attempt=*/0));
  for (size_t i = 0; i < states.size(); ++i)
    grown[i] = grown[i] && space.unit_roundoff() * std::sqrt(rounding2[i]) > 0.1 * bound * std::sqrt(states[i].b2);
  return grown;
}

/// Where u has grown at the end, as of GMRES that stagnated, A is singular to the dtype, and zero replaces u.
template <class Space, class Method>
void judge_growth(Space& space, const Method& method, typename Space::States& states) {
  const auto is_doubtful = [](const SampleState& s) {
    const bool ended = kMayExhaust<Method> ? s.status == SolveStatus::kStagnated : is_unsolved(s.status);
    return ended && s.returned == Returned::kLast && is_far_from_solved(s);
  };
  if (std::none_of(states.begin(), states.end(), is_doubtful)) return;
  const auto grown = have_grown(space, method, states);
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (!is_doubtful(s) || !grown[i]) continue;
    s.returned = Returned::kZero;
    s.status = SolveStatus::kBreakdown;
  }
}

/// Whether the true residual of a method whose residual never grows has grown all the same, far from solved: u has
/// grown along a null vector, where the recursive residual sees nothing.
template <class Method, class Space>
bool has_lost_residual(const Space& space, const SampleState& s) {
  if constexpr (!kNeverGrows<Method>) return false;
  else
    return !space.is_preconditioned() && is_unsolved(s.status) && is_far_from_solved(s) && s.residual2 > 1.1 * s.best2;
}

/// Which iterate each sample is to hand out; returns whether all hand out their last. In this order:
///   1. A sample whose residual is above ‖b‖, or lost, is doubted: kBestOrZero. The others begin at kLast.
///   2. accept_at_rounding_floor() gives kLast back to those at rounding. Of a direct method,
///      judge_numerical_singularity() may do so too, or sets kZero; who is still doubted is a BREAKDOWN.
///      accept_by_energy() gives kLast to all doubted that did not break down, with DIVERGED where the energy does not
///      fall. judge_growth() sets kZero where u has grown.
///   3. Of those at kLast, what ran away goes back to kBestOrZero, DIVERGED of step 2 included; others may get kBest or
///      kBeforeBreakdown.
template <class Space, class Method>
bool choose_answers(Space& space, Method& method, typename Space::States& states, bool track) {
  for (auto& s : states) {
    const bool may_be_worse = is_unsolved(s.status) || s.status == SolveStatus::kBreakdown;
    const bool is_lost = track && has_lost_residual<Method>(space, s);
    s.returned =
        is_lost || (may_be_worse && is_above_b(s, space.unit_roundoff())) ? Returned::kBestOrZero : Returned::kLast;
  }
  accept_at_rounding_floor(space, method, states);
  if constexpr (kIsExact<Method>) judge_numerical_singularity(space, method, states, track);
  if constexpr (kDescendsEnergy<Method>) accept_by_energy(space, method, states);
  if constexpr (kMayGrow<Method>)
    if (track) judge_growth(space, method, states);
  bool all_last = true;
  for (auto& s : states) {
    if (s.returned == Returned::kLast) {
      if (ran_away(s)) s.returned = Returned::kBestOrZero;
      else if (left_rounding_of_b(s) || (kIsExact<Method> && s.floor2 > 0.0 && was_better(s)))
        s.returned = Returned::kBest;
      else if (!track && s.status == SolveStatus::kBreakdown) s.returned = Returned::kBeforeBreakdown;
    }
    all_last = all_last && s.returned == Returned::kLast;
  }
  return all_last;
}

/// Runs the samples again that are not to hand out their last iterate, for as many iterations as `iteration_limit`
/// says. The others stay at zero.
template <class Space, class Method, class Limit>
void run_again(Space& space, Method& method, typename Space::States& states, double rtol, bool track,
               const Limit& iteration_limit) {
  for (size_t i = 0; i < states.size(); ++i)
    states[i].rewind(states[i].returned == Returned::kLast ? 0 : iteration_limit(i));
  space.reset();
  run(space, method, states, rtol, track);
}

/// For samples whose best iterate, by the recursive residual, has a true one above ‖b‖, or has lost it: runs them again
/// for a half of its iterations, a quarter and so on. Of these iterates, the best one and zero, it takes the one with
/// the least true residual.
template <class Space, class Method>
void take_least_of_halves(Space& space, Method& method, typename Space::States& states, double rtol, bool track) {
  const auto is_lost = [&](const SampleState& s) { return track && has_lost_residual<Method>(space, s); };
  const auto is_worse = [&](const SampleState& s) {
    return s.returned == Returned::kBestOrZero && (is_lost(s) || is_above_b(s, space.unit_roundoff()));
  };
  if (std::none_of(states.begin(), states.end(), is_worse)) return;
  const auto full_run = states;
  auto least = states;  // of true residual, so far; at first that of zero where it is above ‖b‖
  for (auto& s : least) {
    if (!is_worse(s) || s.residual2 < s.b2) continue;
    s.iterations = 0;
    s.residual2 = s.b2;
  }
  bool goes_on = true;
  for (int halvings = 1; goes_on; ++halvings) {
    run_again(space, method, states, rtol, track,
              [&](size_t i) { return full_run[i].iterations >> (is_worse(full_run[i]) ? halvings : 0); });
    conclude(space, method, states, rtol);
    goes_on = false;
    for (size_t i = 0; i < states.size(); ++i) {
      if (!is_worse(full_run[i])) continue;
      // Of those that are hardly worse, the first has the smallest u.
      const double enough2 = (is_lost(full_run[i]) ? 1.02 : 1.0) * least[i].residual2;
      const bool is_new_least = states[i].residual2 < enough2;
      if (is_new_least) least[i] = states[i];
      const bool may_fall = is_new_least || least[i].iterations == 0 || is_lost(full_run[i]);
      goes_on = goes_on || (states[i].iterations > 1 && may_fall);
    }
  }
  run_again(space, method, states, rtol, track, [&](size_t i) { return least[i].iterations; });
  conclude(space, method, states, rtol);
}

/// Takes zero in place of a best iterate that has grown.
template <class Space, class Method>
void drop_grown(Space& space, Method& method, typename Space::States& states, double rtol, bool track) {
  const auto found = states;
  const auto has_grown = have_grown(space, method, states);
  const auto is_dropped = [&](size_t i) { return has_grown[i] && found[i].returned == Returned::kBestOrZero; };
  bool any = false;
  for (size_t i = 0; i < states.size(); ++i) any = any || is_dropped(i);
  if (!any) return;
  run_again(space, method, states, rtol, track,
            [&](size_t i) { return is_dropped(i) ? int64_t{0} : found[i].iterations; });
  conclude(space, method, states, rtol);
}

/// Makes the iterates that are to be handed out in place of the last ones, by the same steps as before: a
/// method that went on from its true residual does so again. Where no residual was looked at, a pass that tracks them
/// finds the best one, or the iteration that broke down. The other samples keep what they have. The cold path.
template <class Space, class Method>
void replay(Space& space, Method& method, typename Space::States& states, double rtol, bool track) {
  const auto first = states;
  const auto kept = method.x;
  if (!track) run_again(space, method, states, rtol, /*track=*/true, [&](size_t i) { return first[i].cap; });
  const auto tracked = states;
  run_again(space, method, states, rtol, track, [&](size_t i) {
    if (tracked[i].returned == Returned::kZero) return int64_t{0};
    return tracked[i].returned == Returned::kBeforeBreakdown ? tracked[i].iterations : tracked[i].best;
  });
  conclude(space, method, states, rtol);
  take_least_of_halves(space, method, states, rtol, track);
  if constexpr (kMayGrow<Method>)
    if (track) drop_grown(space, method, states, rtol, track);

  const auto is_remade = space.map(states, [](const SampleState& s) { return s.returned != Returned::kLast; });
  for (size_t i = 0; i < states.size(); ++i) {
    if (is_remade[i]) states[i].status = first[i].status;
    else states[i] = first[i];
  }
  method.x = space.select(is_remade, kept, method.x);
}

}  // namespace detail

/// Solves every sample that `states` holds active, from zero or the space's start. The result is method.x, to which the
/// caller adds the start. With `guarded`, a sample whose last iterate is of no use is run again, to the iterate that
/// its Returned names.
template <LoopSpace Space, class Method>
void iterate(Space& space, Method& method, typename Space::States& states, double rtol, bool guarded) {
  const bool track = rtol > 0.0;
  detail::run(space, method, states, rtol, track);
  detail::conclude(space, method, states, rtol);
  if (!guarded || detail::choose_answers(space, method, states, track)) return;
  detail::replay(space, method, states, rtol, track);
}

}  // namespace prdp
