#pragma once
#include <cmath>
#include <cstdint>
#include <limits>

#include "prdp/kernels/scales.h"
#include "prdp/solvers/batch_arrays.h"
#include "prdp/solvers/iterate.h"
#include "prdp/solvers/start.h"

/// One sample from its right-hand side to its report: the same text in the CPU loops (solve_samples.cpp) and in a
/// kernel of a GPU (gpu/device/solve.h).
namespace prdp {

/// Whether a sample needs no iterations, or gets none, by the largest numbers of b and of its start, which is 0 without
/// one.
template <class T, class IsFinite, class HasZero>
bool is_settled_beforehand(T b, T start, const IsFinite& a_is_finite, const HasZero& divides_by_zero,
                           SampleOutcome& outcome) {
  const auto settle = [&](SolveStatus status) {
    outcome = zero_instead(status);
    return true;
  };
  if (!std::isfinite(b) || !std::isfinite(start)) return settle(SolveStatus::kNonfiniteInput);
  if (!a_is_finite()) return settle(SolveStatus::kNonfiniteOperator);
  if (divides_by_zero()) return settle(SolveStatus::kZeroDiagonal);
  if (b == T(0)) return settle(SolveStatus::kConverged);
  return false;
}

/// Stores u = factor/scale x, as A' = factor A and b' = scale b; returns its largest number, which is not finite if one
/// leaves the range of T.
template <class Space, class T>
T store_solution(Space& space, typename Space::Vector x, T scale, T* u) {
  int exponent = std::ilogb(space.factor()) - std::ilogb(scale);
  if (std::abs(exponent) > std::numeric_limits<T>::max_exponent - 2) {  // no number of T
    const int in_place = exponent / 2;
    space.scale(std::ldexp(T(1), in_place), x);
    exponent -= in_place;
  }
  return space.store(x, std::ldexp(T(1), exponent), u);
}

/// Solves a sample that is not settled beforehand. b is scaled by a power of two to the order of one, so that no square
/// over- or underflows and solve(2^k b) = 2^k solve(b) holds to the last bit.
template <class Space, class Method, class T>
SampleOutcome solve_sample(Space& space, Method& method, const GivenSample<T>& of) {
  typename Space::States states{};
  SampleState& state = states[0];
  state.cap = of.cap;
  space.begin(state);
  const T scale = kernels::power_of_two_scale(of.magnitude);
  space.load(of.b, scale, space.b());
  const double rounding = subnormal_rounding<T>(scale, space.unknowns());
  bool consistent = true;
  if (space.is_singular()) {
    const T whole = std::sqrt(space.dot(space.b(), space.b()));
    const T outside = space.project(space.b());
    consistent = outside <= std::max(consistency_bound<T>(of.rtol) * whole, static_cast<T>(rounding));
    if (std::sqrt(space.dot(space.b(), space.b())) <= std::numeric_limits<T>::epsilon() * whole)
      return zero_instead(consistent ? SolveStatus::kStagnated : SolveStatus::kInconsistent);
  }
  space.take_b();
  state.b2 = space.b2();
  if (!of.whole_cycles) state.end_cycles_at(of.rtol);
  state.rounding2 = rounding * rounding;
  if (of.x0) start_from(space, of.x0);
  iterate(space, method, states, of.rtol, of.guarded);
  space.add_start(method.x);
  space.project_solution(method.x);
  const T largest = store_solution(space, method.x, scale, of.u);
  return outcome_of<T>(state, of.guarded, consistent, static_cast<double>(largest),
                       [&] { return space.largest_magnitude(method.x) > T(0); });
}

}  // namespace prdp
