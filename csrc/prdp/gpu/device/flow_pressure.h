#pragma once
#include "prdp/gpu/device/flow_grid.h"
#include "prdp/solvers/status.h"

/// The projection of a flow: what comes before and after the solve for the pressure.
namespace prdp::gpu {

/// The closed parts of the fluid, where a pressure has no level.
template <class T>
struct FlowClosedParts {
  const T* of;  // (count, cells), 1 in the cells of a part, 0 in all where there are fewer; null: one of all cells
  int64_t sample;  // entries between two samples; 0: they share the parts
  int count;

  /// Takes off the mean of each part of sample s. The threads of a team own the cells of v that they write.
  template <class Team>
  void without_means(int s, Team& team, int cells, T* v) const {
    for (int k = 0; k < count; ++k) {
      const T* const part = of ? of + s * sample + static_cast<int64_t>(k) * cells : nullptr;
      double sums[2] = {0, 0};
      team.each(
          cells, [&](int i) { return static_cast<double>(part ? part[i] * v[i] : v[i]); },
          [&](int i, double value) {
            sums[0] += value;
            sums[1] += part ? static_cast<double>(part[i]) : 1.0;
          });
      team.sum(sums);
      const T mean = static_cast<T>(sums[0] / (sums[1] > 0 ? sums[1] : 1.0));
      team.each(
          cells, [&](int i) { return part ? v[i] - mean * part[i] : v[i] - mean; },
          [&](int i, T value) { v[i] = value; });
    }
  }
};

/// How much of the pressure of the explicit part is taken off: all of it up to a largest ν.
template <class T>
struct FlowShare {
  FlowNumber<T> nu;
  FlowNumber<double> largest_nu;
  T value(int s) const {
    const T here = nu.value(s);
    const double largest = largest_nu.value(s);
    return static_cast<double>(here) > largest ? static_cast<T>(largest) / here : T(1);
  }
};

/// A velocity: base + added, of which the second counts on free faces alone. Either may be absent. Zero in samples that
/// were refused, or whose solve was: its right-hand side is not finite.
template <class T>
struct FlowVelocity {
  FlowGrid grid;
  FlowField<const T> base, added, free;
  const int64_t *refused, *status_of_solve;  // null: none was

  T at(int s, int c, const FlowPlace& p) const {
    if (refused && refused[s] != 0) return T(0);
    if (status_of_solve && status_of_solve[s] == static_cast<int64_t>(SolveStatus::kNonfiniteInput)) return T(0);
    T value = base ? base.at(s, c, p) : T(0);
    if (added) value += free ? added.at(s, c, p) * free.at(s, c, p) : added.at(s, c, p);
    return value;
  }
};

/// b = factor · div u (+ potential_bar) in the cells whose pressure is unknown, zero in the others; without its means,
/// and zero where the dtype has no normal numbers for it.
template <class T>
struct FlowDivergence {
  FlowVelocity<T> u;
  FlowField<const T> cells, potential_bar;
  FlowClosedParts<T> parts;
  FlowShare<T> share;
  double factor;
  bool for_a_solve;  // else the divergence as it is
  T* b;  // (batch, cells)

  template <class Team>
  void operator()(int s, Team& team) const {
    const auto& grid = u.grid;
    const int n = grid.cells();
    T* const mine = b + static_cast<int64_t>(s) * n;
    const auto store = [&](int i, T value) { mine[i] = value; };
    team.each(n, [&](int i) { return at(s, grid.place(i)); }, store);
    if (!for_a_solve) return;
    parts.without_means(s, team, n, mine);
    if (potential_bar) parts.without_means(s, team, n, mine);  // as project_vjp()
    const T largest = largest_of(team, n, [&](int i) { return std::abs(mine[i]); });
    if (largest < std::numeric_limits<T>::min()) team.each(n, [](int) { return T(0); }, store);
  }

 private:
  T at(int s, const FlowPlace& p) const {
    const auto& grid = u.grid;
    T sum = 0;
    for (int a = grid.first_axis(); a < 3; ++a) {
      const auto next = grid.wrapped(p.moved(a, 1));
      sum += kernels::difference(static_cast<T>(factor / grid.dx[a]), u.at(s, 2 - a, p),
                                 grid.has(next) ? u.at(s, 2 - a, next) : T(0));
    }
    const T inside = cells ? cells.at(s, 0, p) : T(1);
    sum *= inside;
    if (potential_bar && !(u.refused && u.refused[s] != 0)) sum += potential_bar.at(s, 0, p) * inside;
    return sum * share.value(s);
  }
};

/// From the solution of the pressure's equation: the velocity u + factor · grad φ, on the free faces or on all, and φ.
template <class T>
struct FlowCorrection {
  FlowVelocity<T> u;
  FlowField<const T> cells;
  FlowClosedParts<T> parts;
  FlowShare<T> share;
  double factor;
  bool on_all_faces;
  const T *found, *before;  // (batch, cells); `before`: a potential that the share of φ is added to; or null
  T *phi, *potential;  // (batch, cells); the second may be null
  FlowField<T> out, on_free_faces;  // the second may be absent

  template <class Team>
  void operator()(int s, Team& team) const {
    const auto& grid = u.grid;
    const int n = grid.cells();
    const int64_t begin = static_cast<int64_t>(s) * n;
    team.each(
        n, [&](int i) { return cells ? found[begin + i] * cells.at(s, 0, grid.place(i)) : found[begin + i]; },
        [&](int i, T value) { phi[begin + i] = value; });
    parts.without_means(s, team, n, phi + begin);
    if (potential)
      team.each(
          n, [&](int i) { return share.value(s) * phi[begin + i] + (before ? before[begin + i] : T(0)); },
          [&](int i, T value) { potential[begin + i] = value; });
    team.meet();
    for (int a = grid.first_axis(); a < 3; ++a) {
      const int c = 2 - a;
      team.each(
          n, [&](int i) { return corrected(s, c, a, grid.place(i), phi + begin); },
          [&](int i, T value) {
            const auto p = grid.place(i);
            out.at(s, c, p) = value;
            if (on_free_faces) on_free_faces.at(s, c, p) = u.free ? value * u.free.at(s, c, p) : value;
          });
    }
  }

 private:
  T corrected(int s, int c, int axis, const FlowPlace& p, const T* of_sample) const {
    const auto& grid = u.grid;
    const auto value = [&](const FlowPlace& q) {
      return of_sample[(q.at[0] * grid.n[1] + q.at[1]) * grid.n[2] + q.at[2]];
    };
    const auto before_it = grid.wrapped(p.moved(axis, -1));
    T gradient = kernels::difference(static_cast<T>(factor / grid.dx[axis]),
                                     grid.has(before_it) ? value(before_it) : T(0), value(p));
    if (u.free && !on_all_faces) gradient *= u.free.at(s, c, p);
    return u.at(s, c, p) + share.value(s) * gradient;
  }
};

}  // namespace prdp::gpu
