#pragma once
#include <algorithm>
#include <cmath>

#include "prdp/solvers/verdicts.h"

/// Whether an iterate whose residual is above ‖b‖ is what a method for definite operators is made for.
namespace prdp::detail {

/// What energy_falls() is told by: inner products of x, b and the residual r; and ‖A‖ ‖x‖².
struct InnerProducts {
  double x_b, x_r, r_b, r_r, b_b, x_Ar, r_Ar, x_x, Ar_Ar, norm_A_x_x;
};

/// Whether the iterates of a method for definite operators do what they are made for: A is symmetric, judged by x·A r
/// and r·A x; it is definite on the plane of x and r; and x is nearer to the solution than zero in the norm of A, which
/// is (x·b)² > (x·r)² for a definite A of either sign. If x·b and x·r agree up to rounding, or x·A x is rounding, x may
/// lie in the null space, and the test fails; the second case does not count where A is known to be definite.
inline bool energy_falls(const InnerProducts& e, double epsilon, bool surely_definite) {
  constexpr double roundings = 2e3;  // of a product of vectors, with much to spare
  const auto clamped = [](double v) { return std::max(v, 0.0); };
  const double scale =
      std::sqrt(e.r_r) * std::sqrt(clamped(e.b_b - 2 * e.r_b + e.r_r)) + std::sqrt(e.x_x) * std::sqrt(e.Ar_Ar);
  const double x_Ax = e.x_b - e.x_r;  // A x = b - r
  const double coupling = clamped(std::abs(e.x_Ar) - roundings * epsilon * scale);  // |x·A r| beyond rounding
  const bool symmetric = std::abs(e.r_b - e.r_r - e.x_Ar) <= roundings * epsilon * scale;
  const bool nearer = e.x_b * e.x_b > e.x_r * e.x_r;
  const double rounding = std::max(roundings * std::abs(e.x_b), surely_definite ? 0.0 : e.norm_A_x_x);
  const bool not_rounding = std::abs(x_Ax) > epsilon * rounding;
  const bool definite = e.r_Ar * x_Ax > coupling * coupling;
  return symmetric && definite && nearer && not_rounding;
}

/// Those of every sample, by one product of the whole batch.
template <class Space, class Method>
auto inner_products(Space& space, Method& method, const typename Space::States& states) {
  const auto& x = method.x;
  const auto &r = method.residual(), &b = space.b();
  auto ar = space.scratch();
  space.apply(r, ar);
  auto all = space.map(states, [](const SampleState&) { return InnerProducts{}; });
  const auto set = [&](double InnerProducts::* product, const auto& value) {
    const auto values = space.values_of(value);
    for (size_t i = 0; i < all.size(); ++i) all[i].*product = values[i];
  };
  set(&InnerProducts::x_b, space.dot(x, b));
  set(&InnerProducts::x_r, space.dot(x, r));
  set(&InnerProducts::r_b, space.dot(r, b));
  set(&InnerProducts::r_r, space.dot(r, r));
  set(&InnerProducts::b_b, space.dot(b, b));
  set(&InnerProducts::x_Ar, space.dot(x, ar));
  set(&InnerProducts::r_Ar, space.dot(r, ar));
  set(&InnerProducts::x_x, space.dot(x, x));
  set(&InnerProducts::Ar_Ar, space.dot(ar, ar));
  space.fill_zero(ar);
  const auto norm_a = space.operator_norm(), u2 = space.values_of(space.solution2(x));  // ‖A‖ and u without their scale
  for (size_t i = 0; i < all.size(); ++i) all[i].norm_A_x_x = norm_a[i] * std::sqrt(u2[i] * all[i].x_x);
  return all;
}

/// Of the samples that ended above ‖b‖: where the energy falls, the last iterate is handed out; else the sample is
/// DIVERGED. One that broke down is left alone: its A is not definite, and the energy says nothing. For a method whose
/// residual is the true one.
template <class Space, class Method>
void accept_by_energy(Space& space, Method& method, typename Space::States& states) {
  const auto is_above = [](const SampleState& s) {
    return s.returned != Returned::kLast && s.status != SolveStatus::kBreakdown;
  };
  if (std::none_of(states.begin(), states.end(), is_above)) return;
  const auto before = states;
  space.freeze_unless(states, [](const SampleState&) { return true; });
  const auto products = inner_products(space, method, states);
  const auto definite = space.surely_definite();
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (!is_above(s)) {
      s.applications = before[i].applications;  // the product counts for the others alone
      continue;
    }
    s.returned = Returned::kLast;
    if (!energy_falls(products[i], space.unit_roundoff(), definite[i])) s.status = SolveStatus::kDiverged;
  }
}

}  // namespace prdp::detail
