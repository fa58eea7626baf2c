#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "prdp/solvers/stopping.h"

// Functions that a kernel of a GPU holds once: copied to each call, they take a minute to compile there.
#ifndef PRDP_ONCE
#define PRDP_ONCE
#endif

/// The one loop around every method: it counts, checks and decides, per sample. A method (jacobi.h,
/// …) supplies one iteration; a space says what a vector is: one sample in padded memory
/// (sample_space.h), or a batch of plain tensors (tensor_space.h). Both run these same lines.
namespace prdp {

namespace detail {

/// Iterations until one of the samples comes to its end or, with `track`, is to be looked at.
template <class States>
int64_t stride(const States& states, bool track) {
  int64_t n = std::numeric_limits<int64_t>::max();
  for (const auto& s : states)
    if (s.active) n = std::min(n, (track ? std::min(s.cap, s.look) : s.cap) - s.iterations);
  return n;
}

/// At most `cap` iterations of each active sample. With `track`, every residual is looked at that may be
/// small enough.
template <class Space, class Method>
PRDP_ONCE void run(Space& space, Method& method, typename Space::States& states, double rtol, bool track) {
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

/// Recomputes the residual of what is not settled and gives it its final status.
template <class Space, class Method>
PRDP_ONCE void conclude(Space& space, Method& method, typename Space::States& states, double rtol) {
  const auto open = [](const SampleState& s) { return !s.settled; };
  if (std::none_of(states.begin(), states.end(), open)) return;
  space.freeze_unless(states, open);
  const auto residual2 = space.lanes(method.recompute_residual());
  const auto broken = space.broken();
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (s.settled) continue;
    s.residual2 = residual2[i];
    if (broken[i]) s.status = SolveStatus::kBreakdown;
    if (!lost(s)) judge(s, rtol);
  }
  stop_at_rounding_floor(space, method, states, rtol, [rtol](const SampleState& s) {
    const bool unsolved =
        s.status == SolveStatus::kMaxIter || (kLeastResidual<Method> && s.status == SolveStatus::kBreakdown);
    return rtol > 0.0 && !s.settled && unsolved;
  });
  for (auto& s : states) {
    s.active = false;
    s.settled = true;
  }
}

/// Whether the residual is above ‖b‖: zero would be a better answer.
template <class Space>
bool is_above_b(const Space& space, const SampleState& s) {
  return s.residual2 > (1.0 + 256.0 * space.epsilon()) * s.b2;
}

/// Which samples end so, though nothing failed.
template <class Space>
auto worse_than_zero(Space& space, const typename Space::States& states) {
  return space.map(states, [&](const SampleState& s) { return is_unsolved(s.status) && is_above_b(space, s); });
}

/// What energy_falls() is told by: products of x; b; r, its residual; and A r.
struct Energies {
  double xb, xr, rb, rr, bb, x_ar, r_ar, xx, ar2;
};

/// Whether the iterates of a method for definite operators do what they are made for: A is symmetric, judged by x·A r
/// and r·A x; it is definite on the plane of x and r; and x is nearer to the solution than zero in the norm of A, which
/// is (x·b)² > (x·r)² for a definite A of either sign. Where the two agree up to rounding, x lies almost in the null
/// space of A, and says nothing.
inline bool energy_falls(const Energies& e, double epsilon) {
  const auto positive = [](double v) { return std::max(v, 0.0); };
  const double scale =
      std::sqrt(e.rr) * std::sqrt(positive(e.bb - 2 * e.rb + e.rr)) + std::sqrt(e.xx) * std::sqrt(e.ar2);
  const double energy = e.xb - e.xr, across = positive(std::abs(e.x_ar) - 2e3 * epsilon * scale);
  const bool symmetric = std::abs(e.rb - e.rr - e.x_ar) <= 2e3 * epsilon * scale;
  const bool nearer = e.xb * e.xb > e.xr * e.xr;
  const bool not_rounding = std::abs(energy) > 2e3 * epsilon * std::abs(e.xb);
  const bool definite = e.r_ar * energy > across * across;
  return symmetric && definite && nearer && not_rounding;
}

/// The same for each sample, where the method's residual is the true one. One product.
template <class Space, class Method>
auto energy_falls(Space& space, Method& method, const typename Space::States& states) {
  const auto& x = method.x;
  const auto &r = method.residual(), &b = space.b();
  auto ar = space.scratch();
  space.apply(r, ar);
  const auto lanes = [&](const auto& v, const auto& w) { return space.lanes(space.dot(v, w)); };
  const auto xb = lanes(x, b), xr = lanes(x, r), rb = lanes(r, b), rr = lanes(r, r), bb = lanes(b, b);
  const auto x_ar = lanes(x, ar), r_ar = lanes(r, ar), xx = lanes(x, x), ar2 = lanes(ar, ar);
  space.fill_zero(ar);
  size_t i = 0;
  return space.map(states, [&](const SampleState&) {
    const Energies e{xb[i], xr[i], rb[i], rr[i], bb[i], x_ar[i], r_ar[i], xx[i], ar2[i]};
    ++i;
    return energy_falls(e, space.epsilon());
  });
}

/// Which samples a method that solves in one iteration leaves with a u so large that its rounding, ε ‖A‖ ‖u‖, is of the
/// order of b: A is singular to the dtype. A small residual says that it is not.
template <class Space, class Method>
auto lost_in_rounding(Space& space, const Method& method, const typename Space::States& states) {
  const auto doubtful = [](const SampleState& s) { return is_unsolved(s.status) && s.residual2 > 1e-4 * s.b2; };
  auto found = space.map(states, doubtful);
  if (std::none_of(states.begin(), states.end(), doubtful)) return found;
  const auto norm_a = space.operator_norm(), u2 = space.lanes(space.solution2(method.x));
  for (size_t i = 0; i < states.size(); ++i)
    found[i] = found[i] && space.epsilon() * norm_a[i] * std::sqrt(u2[i]) > 0.25 * std::sqrt(states[i].b2);
  return found;
}

}  // namespace detail

/// Solves every sample that `states` holds active, from zero or the space's start; the result is method.x, but for
/// that start. A sample that overflows or diverges, or ends worse than zero without an excuse, is run again for as many
/// iterations as gave its smallest residual, unless the iterations are wanted as they come.
template <class Space, class Method>
void iterate(Space& space, Method& method, typename Space::States& states, double rtol, bool guarded) {
  using namespace detail;
  const bool track = rtol > 0.0;
  const auto caps = space.map(states, [](const SampleState& s) { return s.cap; });
  const auto any = [](const auto& rows) { return std::find(rows.begin(), rows.end(), true) != rows.end(); };
  run(space, method, states, rtol, track);
  conclude(space, method, states, rtol);
  if (!guarded) return;
  auto worse = worse_than_zero(space, states);
  auto useless = space.map(states, [](const SampleState&) { return false; });  // zero takes their place
  if constexpr (kIsExact<Method>) {
    useless = lost_in_rounding(space, method, states);
    for (size_t i = 0; i < states.size(); ++i) worse[i] = worse[i] || useless[i];
  }
  if (any(worse)) {
    if constexpr (kDescendsEnergy<Method>) {
      const auto before = states;
      space.freeze_unless(states, [](const SampleState&) { return true; });
      const auto falls = energy_falls(space, method, states);
      for (size_t i = 0; i < states.size(); ++i) {
        if (worse[i] && !falls[i]) states[i].status = SolveStatus::kDiverged;
        if (!worse[i]) states[i].applications = before[i].applications;  // a batch is looked at as a whole
        worse[i] = false;
      }
    } else if constexpr (kIsExact<Method>) {
      for (size_t i = 0; i < states.size(); ++i)
        if (worse[i]) states[i].status = SolveStatus::kBreakdown;
    }
  }
  auto again = space.map(states, [&](const SampleState& s) {
    return lost(s) || left_rounding_of_b(s) || (!track && s.status == SolveStatus::kBreakdown);
  });
  for (size_t i = 0; i < states.size(); ++i) again[i] = again[i] || worse[i];
  if (!any(again)) return;

  // The cold path. Where no residual was looked at, a watched pass finds the best iterate, or the
  // iteration that broke down; then that iterate is remade, by the same steps: a method that went on from
  // its true residual does so again. The other samples keep what they have.
  const auto first = states;
  const auto kept = method.x;
  if (!track) {
    for (size_t i = 0; i < states.size(); ++i) states[i].run_again(again[i] ? caps[i] : 0);
    space.reset();
    run(space, method, states, rtol, /*track=*/true);
  }
  const auto watched = states;
  const auto remake = [&](const auto& wanted) {
    for (size_t i = 0; i < states.size(); ++i) states[i].run_again(again[i] ? wanted(i) : 0);
    space.reset();
    run(space, method, states, rtol, track);
    conclude(space, method, states, rtol);
  };
  remake([&](size_t i) {
    if (useless[i]) return int64_t{0};
    return lost(first[i]) || left_rounding_of_b(first[i]) || worse[i] ? watched[i].best : watched[i].iterations;
  });
  for (size_t i = 0; i < states.size(); ++i)
    worse[i] = (worse[i] || (again[i] && lost(first[i]))) && is_above_b(space, states[i]);
  if (any(worse)) {  // a recursive residual had said otherwise
    const auto remade = states;
    remake([&](size_t i) { return worse[i] ? 0 : remade[i].iterations; });
  }
  for (size_t i = 0; i < states.size(); ++i) {
    if (again[i]) states[i].status = first[i].status;
    else states[i] = first[i];
  }
  method.x = space.select(again, kept, method.x);
}

}  // namespace prdp
