#pragma once
#include "prdp/gpu/device/broadcast_sum.h"
#include "prdp/gpu/device/flow.h"

/// The reverse of the explicit part: each cotangent gathers from the points that read its value.
namespace prdp::gpu {

template <class T>
struct FlowReverse {
  FlowTerms<T> terms;
  FlowField<const T> change_bar;

  /// The cotangent of the tendency at a face.
  T tendency_bar(int s, int c, const FlowPlace& p) const {
    const T g = change_bar.at(s, c, p) * static_cast<T>(terms.dt);
    return terms.free ? g * terms.free.at(s, c, p) : g;
  }
  kernels::AdvectionBars<T> bars(int s, int c, int axis, const FlowPlace& p) const {
    const auto read = terms.point(s, c, axis, p);
    const T diffusion = terms.diffusion(s, axis), quarter_dx = terms.quarter_dx(axis), g = tendency_bar(s, c, p);
    return terms.upwind ? kernels::advected_back<true>(read, diffusion, quarter_dx, g)
                        : kernels::advected_back<false>(read, diffusion, quarter_dx, g);
  }

  /// Of a value with ghosts. The place of a reader is the value's without the offset at which it reads.
  T of_padded(int s, int c, const FlowPlace& q) const {
    const auto& grid = terms.grid;
    const int own = 2 - c;
    T sum = 0;
    const auto add_reader = [&](int channel, int axis, const FlowPlace& reader, auto&& part) {
      if (grid.has(reader)) sum += part(bars(s, channel, axis, reader));
    };
    using Bars = kernels::AdvectionBars<T>;
    for (int a = grid.first_axis(); a < 3; ++a) {
      const bool is_own = a == own;
      add_reader(c, a, q.moved(a, 1), [&](const Bars& b) { return is_own ? b.before + b.low : b.before; });
      add_reader(c, a, q, [&](const Bars& b) { return is_own ? b.here + (b.low + b.high) : b.here; });
      add_reader(c, a, q.moved(a, -1), [&](const Bars& b) { return is_own ? b.after + b.high : b.after; });
      if (is_own) continue;
      // c carries the component along a through edges along its own axis.
      const auto low = [](const Bars& b) { return b.low; };
      const auto high = [](const Bars& b) { return b.high; };
      const int carried = 2 - a;
      add_reader(carried, own, q, low);
      add_reader(carried, own, q.moved(a, 1), low);
      add_reader(carried, own, q.moved(own, -1), high);
      add_reader(carried, own, q.moved(own, -1).moved(a, 1), high);
    }
    return sum;
  }

  /// Of a value, with those of the ghosts that were made of it along the axes that `reflects` marks.
  T with_ghosts(int s, int c, const FlowPlace& q, const bool (&reflects)[3]) const {
    const auto& grid = terms.grid;
    T sum = 0;
    for (int reflected_axes = 0; reflected_axes < 8; ++reflected_axes) {
      T factor = 1;
      auto image = q;
      bool exists = true;
      for (int a = 0; a < 3 && exists; ++a)
        if (reflected_axes >> a & 1) exists = reflects[a] && a >= grid.first_axis() && reflect(a, c, image, factor);
      if (exists && factor != T(0)) sum += factor * of_padded(s, c, image);
    }
    return sum;
  }

 private:
  /// The ghost along an axis that was made of the value at a place; false if there is none.
  bool reflect(int axis, int c, FlowPlace& p, T& factor) const {
    const auto& grid = terms.grid;
    const int last = grid.n[axis] - 1;
    const bool is_first = p.at[axis] == 0, is_last = p.at[axis] == last;
    if (!is_first && !is_last) return false;
    const bool high = (grid.ends[axis] == kPeriodicEnds) == is_first;
    factor *= grid.template ghost_factor<T>(axis, high, c);
    p.at[axis] = high ? last + 1 : -1;
    return true;
  }
};

/// The cotangent of u from those of the velocity with its boundary values and of its change.
template <class T>
struct FlowStateBars {
  FlowReverse<T> reverse;
  FlowField<const T> velocity_bar;
  FlowField<T> u_bar;

  void operator()(int i) const {
    const auto& grid = reverse.terms.grid;
    const int cells = grid.cells(), field = i / cells, s = field / grid.dim, c = field % grid.dim;
    const auto p = grid.place(i % cells);
    const auto& free = reverse.terms.free;
    const T sum = of_velocity(s, c, p);
    u_bar.at(s, c, p) = free ? sum * free.at(s, c, p) : sum;
  }
  /// Of the velocity with its boundary values.
  T of_velocity(int s, int c, const FlowPlace& p) const {
    const auto& terms = reverse.terms;
    T sum = velocity_bar.at(s, c, p) + reverse.with_ghosts(s, c, p, {true, true, true});
    if (terms.friction) sum -= terms.nu.value(s) * (terms.friction.at(s, c, p) * reverse.tendency_bar(s, c, p));
    return sum;
  }
};

/// The cotangents of the inflow, or of the velocity of a wall, at the faces of an end: (batch, dim, faces).
template <class T>
struct FlowEndBars {
  FlowField<const T> inlet;  // of an inflow
  int axis;
  bool high;
  bool reflects[3];  // the axes whose ghosts were made of those here
  FlowField<T> out;
  int count;

  void operator()(int i, const FlowStateBars<T>& state) const {
    auto faces = state.reverse.terms.grid;
    const int last = faces.n[axis];
    faces.n[axis] = 1;
    const int cells = faces.cells(), field = i / cells, s = field / faces.dim, c = field % faces.dim;
    const auto p = faces.place(i % cells);
    T sum = 2 * state.reverse.with_ghosts(s, c, p.moved(axis, high ? last : -1), reflects);
    if (inlet) sum += inlet.at(s, c, p) * state.of_velocity(s, c, p);
    out.at(s, c, p) = sum;
  }
};

/// The cotangent of ν, a sum over all faces.
template <class T>
struct FlowViscosityBars {
  // Of I - ν dt Δ: its solutions, the cotangents of what they solve for, and -Δ of each channel. Absent: no system.
  FlowField<const T> diffused, lambda;
  const T* patterns[3];
  int64_t sample;  // entries of a pattern between two samples; 0: they share it
  // Of the share of the pressure that is taken off beyond a largest ν. Absent: the whole one is.
  FlowField<const T> change, balanced, potential, potential_bar;
  FlowNumber<double> largest_nu;

  double at(const FlowReverse<T>& reverse, int s, int c, const FlowPlace& p) const {
    const auto& terms = reverse.terms;
    const auto& grid = terms.grid;
    double sum = 0;
    for (int a = grid.first_axis(); a < 3; ++a)
      sum += static_cast<double>(reverse.bars(s, c, a, p).diffusion) / (grid.dx[a] * grid.dx[a]);
    if (terms.friction)
      sum -= static_cast<double>(terms.friction.at(s, c, p) * reverse.tendency_bar(s, c, p)) *
             static_cast<double>(terms.point(s, c, 2 - c, p).here);
    if (!diffused) return sum;
    const double bar = static_cast<double>(lambda.at(s, c, p)), nu = static_cast<double>(terms.nu.value(s));
    sum -= terms.dt * bar * of_pattern(grid, s, c, p);
    if (!balanced || nu <= largest_nu.value(s)) return sum;
    double of_share = bar * static_cast<double>(balanced.at(s, c, p) - change.at(s, c, p));
    if (c == 0 && potential_bar)
      of_share += static_cast<double>(potential_bar.at(s, 0, p)) * static_cast<double>(potential.at(s, 0, p));
    return sum - of_share / nu;
  }

 private:
  /// -Δ of what was diffused. The entries: of the point itself, and of its neighbours low and high along each axis.
  double of_pattern(const FlowGrid& grid, int s, int c, const FlowPlace& p) const {
    const T* entry = patterns[c] + s * sample + (p.at[0] * grid.n[1] + p.at[1]) * grid.n[2] + p.at[2];
    double sum = static_cast<double>(*entry) * static_cast<double>(diffused.at(s, c, p));
    for (int a = grid.first_axis(); a < 3; ++a)
      for (int cells = -1; cells <= 1; cells += 2) {
        const auto q = grid.wrapped(p.moved(a, cells));
        entry += grid.cells();
        if (grid.has(q)) sum += static_cast<double>(*entry) * static_cast<double>(diffused.at(s, c, q));
      }
    return sum;
  }
};

/// The cotangents of all that the explicit part is made of, one after the other: of u, where it is wanted; of its ends;
/// of the force, on the free faces, summed over what shares it; and of ν.
template <class T>
struct FlowBars {
  static constexpr int kMostEnds = 6;
  FlowStateBars<T> state;
  int of_state, ends;
  FlowEndBars<T> end[kMostEnds];
  BroadcastSum force, of_nu;  // of none: without terms
  FlowViscosityBars<T> nu;
  double *force_out, *nu_out;

  void operator()(int i) const {
    if (i < of_state) return state(i);
    i -= of_state;
    for (int k = 0; k < ends; ++k) {
      if (i < end[k].count) return end[k](i, state);
      i -= end[k].count;
    }
    const auto& reverse = state.reverse;
    using At = int[BroadcastSum::kAxes];
    if (i < force.count) {
      force_out[i] =
          force.sum(i, [&](const At& at) { return reverse.tendency_bar(at[0], at[1], {{at[2], at[3], at[4]}}); });
      return;
    }
    i -= force.count;
    nu_out[i] = of_nu.sum(i, [&](const At& at) { return nu.at(reverse, at[0], at[1], {{at[2], at[3], at[4]}}); });
  }
};

}  // namespace prdp::gpu
