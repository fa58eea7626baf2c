#pragma once
#include <cstdint>
#include <utility>

#include "prdp/gpu/device/coarse_grid.h"
#include "prdp/gpu/device/team.h"

/// The V-cycle of kernels/multigrid.h by a team of threads: a loop over the grids, with their sizes as numbers.
namespace prdp::gpu {

template <class T>
struct NoCycle {
  NoCycle(const HierarchyView<T>&, int64_t, T*, T*) {}
  bool exists() const { return true; }
};
template <class S, class A>
struct Cycle;

/// Constants of a kernel without cycles, and with them.
struct NoCycleSetting {
  static constexpr bool kAny = false;
  static constexpr int kVectors = 0, kInBlock = 0;
  static constexpr int64_t kBeyond = 0;
  template <class S>
  using Of = NoCycle<typename S::T>;
};
template <int dimensions, int vectors, int in_block, int64_t beyond>
struct CycleSetting {
  static constexpr bool kAny = true;
  static constexpr int kDim = dimensions;
  static constexpr int kVectors = vectors;    // of a sample, that the preconditioner keeps
  static constexpr int kInBlock = in_block;   // numbers of coarse grids in the memory of the block
  static constexpr int64_t kBeyond = beyond;  // and in that of the device, for those that do not fit
  template <class S>
  using Of = Cycle<S, typename S::A::Cycled>;
};

/// A: of views.h, what the hierarchy was made of.
template <class S, class A>
struct Cycle {
  using T = typename S::T;
  using TeamOfSample = Team<S::kBlocks, S::kThreads>;

  HierarchyView<T> hierarchy;
  int64_t sample;
  T *in_block, *beyond;

  bool exists() const { return grids().count > 0; }

  /// z = M⁻¹ r; x, y and t are memory.
  PRDP_ONCE void apply(TeamOfSample& team, const A& a, const T* r, T* z, T* x, T* y, T* t) const {
    Walk walk{*this, team, a, r, {nullptr, x, y}, t};
    const int last = static_cast<int>(grids().count) - 1;
    for (int level = 0; level < last; ++level) walk.go_down(level);
    walk.solve_coarsest(last);
    const T* found = walk.vectors.x;
    for (int level = last - 1; level >= 0; --level) found = walk.go_up(level, found);
    team.each(A::kUnknowns, [&](int i) { return found[i]; }, [&](int i, T value) { z[i] = value; });
  }

 private:
  static constexpr int fields() { return A::kUnknowns / A::Points::kPoints; }
  const Grids& grids() const { return hierarchy.grids[hierarchy.numbers_of_sample > 0 ? sample : 0]; }
  const T* numbers(int64_t place) const { return hierarchy.numbers + sample * hierarchy.numbers_of_sample + place; }

  /// The right-hand side of a grid and two vectors, which the smoothing steps fill in turn.
  struct Vectors {
    T *b, *x, *y;
  };

  static int points(const CoarseGrid& grid) { return grid.shape[0] * grid.shape[1] * grid.shape[2]; }
  static auto shared(const T* v) { return Shared<S::kBlocks, T>{v}; }

  /// A on the finest grid, and on the others; for all fields.
  struct Finest {
    const A& a;
    const T* diagonals;
    T diagonal(int i) const { return diagonals[i % A::Points::kPoints]; }
    template <class V>
    T product(const V& v, int i) const {
      return a.product(v, i);
    }
  };
  struct Coarse {
    GridStencil<T, A, S::Cycles::kDim> a;
    int points;
    bool transposed;
    T diagonal(int i) const { return a.coefficients[a.kCentre * points + i % points]; }
    template <class V>
    T product(const V& v, int i) const {
      const int point = i % points;
      T sum = 0;
      a.for_each_neighbour(point, [&](int k, int there) {
        if (there < 0) return;
        const int of = transposed ? (a.kOffsets - 1 - k) * points + there : k * points + point;
        sum += a.coefficients[of] * v[i - point + there];
      });
      return sum;
    }
  };

  struct Walk {
    const Cycle& of;
    TeamOfSample& team;
    const A& a;
    const T* r;
    Vectors vectors;  // of the grid where it is
    T* t;
    Vectors finest{};

    const CoarseGrid& grid(int level) const { return of.grids().grid[level]; }
    int64_t entries(int level) const { return int64_t{fields()} * points(grid(level)); }
    const T* right_hand_side(int level) const { return level == 0 ? r : vectors.b; }
    bool transposed() const { return of.hierarchy.transposed != 0; }

    /// The vectors of a coarse grid, which lie behind those of the grids above it.
    Vectors vectors_of(int level) const {
      int64_t place = 0;
      for (int above = 1; above < level; ++above) place += 3 * entries(above);
      const int64_t n = entries(level);
      T* const first = (place + 3 * n <= S::Cycles::kInBlock ? of.in_block : of.beyond) + place;
      return {first, first + n, first + 2 * n};
    }

    PRDP_ONCE void go_down(int level) {
      const CoarseGrid& here = grid(level);
      smooth(level, /*from_zero=*/true);
      take_residual(level);
      const T* from = vectors.y;
      T* const other = vectors.y;
      if (level == 0) finest = vectors;
      vectors = vectors_of(level + 1);
      for (int axis = 0; axis < 3; ++axis) {
        if (!(here.axes >> axis & 1)) continue;
        T* const to = here.axes >> (axis + 1) == 0 ? vectors.b : from == other ? t : other;
        team.meet();
        restrict(here, axis, from, to);
        from = to;
      }
    }
    /// From the solution of the coarser grid to that of this one, which it returns.
    PRDP_ONCE const T* go_up(int level, const T* coarse) {
      vectors = level == 0 ? finest : vectors_of(level);
      // Each smoothing step but the first had swapped them on the way down.
      if (level > 0 && of.hierarchy.smoothing % 2 == 0) std::swap(vectors.x, vectors.y);
      const CoarseGrid& here = grid(level);
      for (int axis = 2; axis >= 0; --axis) {
        if (!(here.axes >> axis & 1)) continue;
        const bool is_last = (here.axes & ((1 << axis) - 1)) == 0;
        T* const to = is_last ? vectors.x : coarse == t ? vectors.y : t;
        team.meet();
        interpolate(here, axis, coarse, to, is_last);
        coarse = to;
      }
      smooth(level, /*from_zero=*/false);
      return vectors.x;
    }
    PRDP_ONCE void solve_coarsest(int level) {
      const T* const b = right_hand_side(level);
      const T* const inverse = of.numbers(of.grids().inverse);
      const int n = points(grid(level));
      const bool by_columns = transposed();
      T* const x = vectors.x;
      team.meet();
      const auto given = shared(b);
      team.for_each(fields() * n, [&](int at) {
        const int i = at % n;
        T sum = 0;
        PRDP_ROLLED for (int j = 0; j < n; ++j) sum += inverse[by_columns ? j * n + i : i * n + j] * given[at - i + j];
        x[at] = sum;
      });
    }

    /// x = M b, or from x on; y is memory.
    PRDP_ONCE void smooth(int level, bool from_zero) {
      kernels::SmoothingSteps steps(grid(level).radius);
      for (int64_t s = 0; s < of.hierarchy.smoothing; ++s) {
        const kernels::SmoothingStep step = steps.next();
        if (from_zero && s == 0) {
          begin(level, static_cast<T>(step.q));
        } else {
          relax(level, static_cast<T>(step.p), static_cast<T>(step.q));
          std::swap(vectors.x, vectors.y);
        }
      }
    }
    /// x = q D⁻¹ b, and y = 0.
    PRDP_ONCE void begin(int level, T q) {
      const T *const b = right_hand_side(level), *const diagonal = diagonals(level);
      T *const x = vectors.x, *const y = vectors.y;
      const int n = points(grid(level));
      team.for_each(fields() * n, [&](int i) {
        x[i] = q * (b[i] / diagonal[i % n]);
        y[i] = 0;
      });
    }
    const T* diagonals(int level) const {
      using Stencil = GridStencil<T, A, S::Cycles::kDim>;
      return of.numbers(grid(level).coefficients) + int64_t{Stencil::kCentre} * points(grid(level));
    }
    /// y = b - A x
    void take_residual(int level) { relax(level, T(0), T(0)); }
    /// y = x + p (x - y) + q D⁻¹(b - A x); with q = 0, y = b - A x: products are most of what there is to compile, so
    /// there is one text of both.
    PRDP_ONCE void relax(int level, T p, T q) {
      if (level == 0) return relax(Finest{a, diagonals(0)}, r, A::kUnknowns, p, q);
      const CoarseGrid& here = grid(level);
      const int n = points(here);
      const Coarse coarse{
          {of.numbers(here.coefficients), {here.shape[0], here.shape[1], here.shape[2]}}, n, transposed()};
      relax(coarse, vectors.b, fields() * n, p, q);
    }
    template <class Level>
    PRDP_ONCE void relax(const Level& level, const T* b, int n, T p, T q) {
      const T* const x = vectors.x;
      T* const y = vectors.y;
      team.meet();
      const auto of_all = shared(x);
      team.for_each(n, [&](int i) {
        const T left = b[i] - level.product(of_all, i);
        if (q == T(0)) {
          y[i] = left;
          return;
        }
        const T before = p == T(0) ? T(0) : p * (x[i] - y[i]);
        y[i] = x[i] + before + q * left / level.diagonal(i);
      });
    }

    static CoarsenedAxis line_of(const CoarseGrid& of, int axis) {
      int shape[3] = {of.shape[0], of.shape[1], of.shape[2]};
      for (int d = 0; d < axis; ++d)
        if (of.axes >> d & 1) shape[d] = static_cast<int>(kernels::coarse_points(shape[d], A::periodic(d)));
      return {shape, axis, A::periodic(axis)};
    }
    enum class Weights { kInterpolation, kRestriction };
    /// Of a symmetric operator they are the same.
    const T* weights(const CoarseGrid& here, int axis, const CoarsenedAxis& line, Weights which) const {
      const bool second = which == Weights::kRestriction && !of.grids().is_symmetric;
      return of.numbers(here.weights[axis]) + (second ? 2 * line.weights() : 0);
    }
    PRDP_ONCE void restrict(const CoarseGrid& here, int axis, const T* fine, T* coarse) {
      const CoarsenedAxis line = line_of(here, axis);
      const T* const left = weights(here, axis, line, transposed() ? Weights::kInterpolation : Weights::kRestriction);
      const T* const right = left + line.weights();
      const auto given = shared(fine);
      team.for_each(fields() * line.coarse_entries(),
                    [&](int i) { coarse[i] = line.restricted(given, left, right, i); });
    }
    PRDP_ONCE void interpolate(const CoarseGrid& here, int axis, const T* coarse, T* fine, bool adds) {
      const CoarsenedAxis line = line_of(here, axis);
      const T* const left = weights(here, axis, line, transposed() ? Weights::kRestriction : Weights::kInterpolation);
      const T* const right = left + line.weights();
      const auto given = shared(coarse);
      team.for_each(fields() * line.outer * line.n * line.inner, [&](int i) {
        const T value = line.interpolated(given, left, right, i);
        fine[i] = adds ? fine[i] + value : value;
      });
    }
  };
};

}  // namespace prdp::gpu
