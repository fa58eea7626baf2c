#pragma once
#include "prdp/solvers/method_properties.h"
#include "prdp/solvers/rounding_floor.h"
#include "prdp/solvers/space.h"
#include "prdp/solvers/verdicts.h"

/// How the loop around the methods (iterate.h) looks at residuals, and stops the samples that are done.
namespace prdp::detail {

/// Of each sample, whether the space of a method of least residuals is exhausted; nothing for other methods.
template <class Space, class Method>
auto exhausted_of(Space& space, const Method& method) {
  if constexpr (kMayExhaust<Method>) return space.values_of(method.exhausted());
  else return 0;
}
template <class Method, class Exhausted>
bool is_exhausted([[maybe_unused]] const Exhausted& exhausted, [[maybe_unused]] size_t i) {
  if constexpr (kMayExhaust<Method>) return exhausted[i] != 0.0;
  else return false;
}

/// Judges each active sample by the residual that the method knows. Stops what diverged, overflowed or broke down;
/// samples that seem converged go on as candidates. Returns whether there are any.
template <class Space, class Method, class Exhausted>
bool judge_known_residuals(Space& space, Method& method, typename Space::States& states, double rtol,
                           const Exhausted& exhausted) {
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
      if (s.active && rtol > 0.0) judge_progress(s, is_exhausted<Method>(exhausted, i));
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
    stop_at_rounding_floor(space, method, states, rtol, [rtol](const SampleState& s) {
      return rtol > 0.0 && s.active && !s.candidate && is_idle<Method>(s);
    });
  }
  if constexpr (kMayExhaust<Method>)
    stop_at_rounding_floor(space, method, states, rtol, [](const SampleState& s) {
      return s.active && !s.candidate && s.cycles_without_progress > 0;
    });
}

/// Judges the candidates by their true residual, as a recursive one may have drifted from it.
template <class Space, class Method, class Exhausted>
void confirm_candidates(Space& space, Method& method, typename Space::States& states, double rtol,
                        const Exhausted& exhausted) {
  space.freeze_unless(states, [](const SampleState& s) { return s.candidate; });
  const auto true_residual2 = space.values_of(method.recompute_residual());
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (!s.candidate) continue;
    s.residual2 = true_residual2[i];
    judge(s, rtol);
    if (s.active && has_drifted(s, rtol)) s.stop(SolveStatus::kStagnated);
    if (s.status == SolveStatus::kConverged && is_exhausted<Method>(exhausted, i))
      s.status = SolveStatus::kConvergedBreakdown;
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
