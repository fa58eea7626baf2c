#pragma once
#include <algorithm>
#include <cmath>

#include "prdp/solvers/verdicts.h"

/// Whether an iterate whose residual is above ‖b‖ is what a method for definite operators is made for.
namespace prdp::detail {

/// What energy_falls() is told by: products of x; b; r, its residual; A r; and ‖A‖ ‖x‖².
struct Energies {
  double xb, xr, rb, rr, bb, x_ar, r_ar, xx, ar2, largest;
};

/// Whether the iterates of a method for definite operators do what they are made for: A is symmetric, judged by x·A r
/// and r·A x; it is definite on the plane of x and r; and x is nearer to the solution than zero in the norm of A, which
/// is (x·b)² > (x·r)² for a definite A of either sign. Where the two agree up to rounding, or x·A x is the rounding of
/// A x, x lies almost in the null space of A, and says nothing, unless A has none for sure.
inline bool energy_falls(const Energies& e, double epsilon, bool surely_definite) {
  constexpr double roundings = 2e3;  // of a product of vectors, with much to spare
  const auto positive = [](double v) { return std::max(v, 0.0); };
  const double scale =
      std::sqrt(e.rr) * std::sqrt(positive(e.bb - 2 * e.rb + e.rr)) + std::sqrt(e.xx) * std::sqrt(e.ar2);
  const double energy = e.xb - e.xr, across = positive(std::abs(e.x_ar) - roundings * epsilon * scale);
  const bool symmetric = std::abs(e.rb - e.rr - e.x_ar) <= roundings * epsilon * scale;
  const bool nearer = e.xb * e.xb > e.xr * e.xr;
  const double rounding = std::max(roundings * std::abs(e.xb), surely_definite ? 0.0 : e.largest);
  const bool not_rounding = std::abs(energy) > epsilon * rounding;
  const bool definite = e.r_ar * energy > across * across;
  return symmetric && definite && nearer && not_rounding;
}

/// Of the samples that ended above ‖b‖: where the energy falls, the last iterate is handed out; else the sample is
/// DIVERGED. One that broke down is left alone: its A is not definite, and the energy says nothing. For a method whose
/// residual is the true one. One product of the whole batch, which counts for these samples alone.
template <class Space, class Method>
void accept_by_energy(Space& space, Method& method, typename Space::States& states) {
  const auto is_above = [](const SampleState& s) {
    return s.returned != Returned::kLast && s.status != SolveStatus::kBreakdown;
  };
  if (std::none_of(states.begin(), states.end(), is_above)) return;
  const auto before = states;
  space.freeze_unless(states, [](const SampleState&) { return true; });
  const auto& x = method.x;
  const auto &r = method.residual(), &b = space.b();
  auto ar = space.scratch();
  space.apply(r, ar);
  const auto values_of = [&](const auto& v, const auto& w) { return space.values_of(space.dot(v, w)); };
  const auto xb = values_of(x, b), xr = values_of(x, r), rb = values_of(r, b), rr = values_of(r, r),
             bb = values_of(b, b);
  const auto x_ar = values_of(x, ar), r_ar = values_of(r, ar), xx = values_of(x, x), ar2 = values_of(ar, ar);
  space.fill_zero(ar);
  const auto norm_a = space.operator_norm(), u2 = space.values_of(space.solution2(x));  // ‖A‖ and u without their scale
  const auto definite = space.surely_definite();
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (!is_above(s)) {
      s.applications = before[i].applications;
      continue;
    }
    s.returned = Returned::kLast;
    const Energies e{.xb = xb[i],
                     .xr = xr[i],
                     .rb = rb[i],
                     .rr = rr[i],
                     .bb = bb[i],
                     .x_ar = x_ar[i],
                     .r_ar = r_ar[i],
                     .xx = xx[i],
                     .ar2 = ar2[i],
                     .largest = norm_a[i] * std::sqrt(u2[i] * xx[i])};
    if (!energy_falls(e, space.epsilon(), definite[i])) s.status = SolveStatus::kDiverged;
  }
}

}  // namespace prdp::detail
