#pragma once
#include "prdp/gpu/device/arguments.h"
#include "prdp/kernels/coarsening.h"

/// The grids of a hierarchy as kernels see them. Their sizes are numbers of the run: a function for each would take
/// minutes to compile.
namespace prdp::gpu {

/// The index after `cells` more along an axis of n; -1 beyond the end of one that is not periodic.
inline int moved(int index, int cells, int n, bool periodic) {
  const int next = index + cells;
  if (next >= 0 && next < n) return next;
  if (!periodic) return -1;
  return next < 0 ? next + n : next - n;
}

/// 3^dim coefficients a point, which couple it to neighbours at most one cell away; one field for each offset, in the
/// order of z, y and x.
template <class T, class A, int dim>
struct GridStencil {
  static constexpr int kOffsets = dim == 1 ? 3 : dim == 2 ? 9 : 27;
  static constexpr int kCentre = kOffsets / 2;
  const T* coefficients;
  int shape[3];  // z, y, x

  int points() const { return shape[0] * shape[1] * shape[2]; }
  static int place(int dz, int dy, int dx) { return 9 * dz + 3 * dy + dx + kCentre; }
  static int step(int axis) { return axis == 0 ? 9 : axis == 1 ? 3 : 1; }

  /// f(place, neighbour) for each offset; -1 where it leads out of the grid.
  template <class F>
  void for_each_neighbour(int point, const F& f) const {
    const int x = point % shape[2], y = point / shape[2] % shape[1], z = point / (shape[2] * shape[1]);
    for (int dz = dim > 2 ? -1 : 0; dz <= (dim > 2 ? 1 : 0); ++dz) {
      const int at_z = moved(z, dz, shape[0], A::periodic(0));
      for (int dy = dim > 1 ? -1 : 0; dy <= (dim > 1 ? 1 : 0); ++dy) {
        const int at_y = moved(y, dy, shape[1], A::periodic(1));
        PRDP_UNROLL for (int dx = -1; dx <= 1; ++dx) {
          const int at_x = moved(x, dx, shape[2], A::periodic(2));
          f(place(dz, dy, dx), (at_z | at_y | at_x) < 0 ? -1 : (at_z * shape[1] + at_y) * shape[2] + at_x);
        }
      }
    }
  }
};

/// An axis along which a grid is coarsened, those before it already being so. A field is `outer` times n times `inner`
/// entries; points between coarse ones have weights, one field of `outer` times between() times `inner`.
struct CoarsenedAxis {
  int n, coarse, inner, outer;
  bool periodic;

  CoarsenedAxis(const int (&shape)[3], int axis, bool closed)
      : n(shape[axis]),
        coarse(static_cast<int>(kernels::coarse_points(n, closed))),
        inner(1),
        outer(1),
        periodic(closed) {
    for (int d = 0; d < 3; ++d)
      if (d != axis) (d < axis ? outer : inner) *= shape[d];
  }

  int between() const { return n - coarse; }
  int weights() const { return outer * between() * inner; }
  int coarse_entries() const { return outer * coarse * inner; }
  int fine_entries() const { return outer * n * inner; }
  /// The place on the axis of a coarse point, and of one between.
  int of_coarse(int j) const { return periodic ? 2 * j : 2 * j + 1; }
  int of_between(int k) const { return periodic ? 2 * k + 1 : 2 * k; }
  /// Which of those between lies before a coarse point, and after it; -1: another coarse one, or none.
  int before(int j) const { return !periodic ? j : j > 0 ? j - 1 : n % 2 == 0 ? between() - 1 : -1; }
  int after(int j) const {
    const int k = periodic ? j : j + 1;
    return k < between() ? k : -1;
  }

  /// Entry `at` of line (o, k), which runs along the axis in a field of this extent; and the weights of point b
  /// between.
  int entry_of(int o, int at, int extent, int k) const { return (o * extent + at) * inner + k; }
  int weight_of(int o, int b, int k) const { return entry_of(o % outer, b, between(), k); }

  /// At a coarse entry, the fine one there and its two neighbours with their weights.
  template <class V, class T>
  T restricted(const V& fine, const T* left, const T* right, int entry) const {
    const int k = entry % inner, row = entry / inner, j = row % coarse, o = row / coarse;
    const auto term = [&](const T* weight, int b) {
      if (b < 0) return T(0);
      return weight[weight_of(o, b, k)] * fine[entry_of(o, of_between(b), n, k)];
    };
    return fine[entry_of(o, of_coarse(j), n, k)] + term(right, before(j)) + term(left, after(j));
  }
  /// At a fine entry, what it takes of the coarse ones.
  template <class V, class T>
  T interpolated(const V& of_coarse, const T* left, const T* right, int entry) const {
    const int k = entry % inner, row = entry / inner, place = row % n, o = row / n, half = place / 2;
    const auto at = [&](int j) { return of_coarse[entry_of(o, j, coarse, k)]; };
    if (place % 2 == (periodic ? 0 : 1)) return at(half);
    const int weight = weight_of(o, half, k);
    const int before = periodic ? half : half - 1, after = periodic ? (half + 1) % coarse : half;
    return (before >= 0 ? left[weight] * at(before) : T(0)) + (after < coarse ? right[weight] * at(after) : T(0));
  }
};

/// Coarse point i along an axis, and the fine points around it.
struct CoarsePoint {
  int inner, j, outer;  // its place in the axes after this one, along it, and in those before
  int fine[3];          // before it, where it lies, and after it
  int before, after;    // the points between coarse ones on its two sides, -1 beyond the grid

  CoarsePoint(const CoarsenedAxis& line, int i)
      : inner(i % line.inner),
        j(i / line.inner % line.coarse),
        outer(i / line.inner / line.coarse),
        before(line.before(j)),
        after(line.after(j)) {
    for (int p = 0; p < 3; ++p)
      fine[p] = line.entry_of(outer, (line.of_coarse(j) + p - 1 + line.n) % line.n, line.n, inner);
  }
};

}  // namespace prdp::gpu
