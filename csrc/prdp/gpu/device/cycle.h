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
  static constexpr int kVectors = vectors;    // of scratch that the preconditioner takes on the finest grid
  static constexpr int kInBlock = in_block;   // numbers of coarse grids in shared memory
  static constexpr int64_t kBeyond = beyond;  // numbers of coarse grids in global memory, at most
  template <class S>
  using Of = Cycle<S, typename S::A::Cycled>;
};

/// S: the constants of the kernel (setting.h). A: the operator on the finest grid (views.h).
template <class S, class A>
struct Cycle {
  using T = typename S::T;
  using TeamOfSample = Team<S::kBlocks, S::kThreads>;

  HierarchyView<T> hierarchy;
  int64_t sample;
  T *in_block, *beyond;  // memory for the vectors of coarse grids

  bool exists() const { return grids().count > 0; }

  /// z = M⁻¹ r; x, y and spare are scratch.
  PRDP_NOINLINE void apply(TeamOfSample& team, const A& a, const T* r, T* z, T* x, T* y, T* spare) const {
    VCycle cycle{*this, team, a, r, {nullptr, x, y}, spare};
    const int coarsest = static_cast<int>(grids().count) - 1;
    for (int level = 0; level < coarsest; ++level) cycle.go_down(level);
    cycle.solve_coarsest(coarsest);
    const T* found = cycle.vectors.x;
    for (int level = coarsest - 1; level >= 0; --level) found = cycle.go_up(level, found);
    team.each(A::kUnknowns, [&](int i) { return found[i]; }, [&](int i, T value) { z[i] = value; });
  }

 private:
  static constexpr int kFields = A::kUnknowns / A::Points::kPoints;
  using Stencil = GridStencil<T, A, S::Cycles::kDim>;

  const Grids& grids() const { return hierarchy.grids[hierarchy.numbers_of_sample > 0 ? sample : 0]; }
  const T* numbers(int64_t place) const { return hierarchy.numbers + sample * hierarchy.numbers_of_sample + place; }

  /// The right-hand side of a grid and two vectors, which the smoothing steps fill in turn.
  struct Vectors {
    T *b, *x, *y;
  };
  /// The weights with which a point between two coarse ones takes them.
  struct Weights {
    const T *left, *right;
  };

  /// A on the finest grid: entry i of all fields.
  struct OnFinest {
    const A& a;
    const T* diagonals;
    T diagonal(int i) const { return diagonals[i % A::Points::kPoints]; }
    template <class V>
    T product(const V& v, int i) const {
      return a.product(v, i);
    }
  };
  /// A, or its transpose, on a coarse grid likewise.
  struct OnCoarse {
    Stencil a;
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

  /// One application of M⁻¹, from grid to grid.
  struct VCycle {
    const Cycle& cycle;
    TeamOfSample& team;
    const A& a;
    const T* r;       // the right-hand side of the finest grid
    Vectors vectors;  // of the grid where it is
    T* spare;
    Vectors finest{};

    // ---- from grid to grid

    /// Smooths, and takes the residual to the right-hand side of the next grid, one axis after the other.
    PRDP_NOINLINE void go_down(int level) {
      const CoarseGrid& here = grid(level);
      smooth(level, /*from_zero=*/true);
      take_residual(level);
      T* const residual = vectors.y;
      if (level == 0) finest = vectors;
      vectors = vectors_of(level + 1);
      const T* from = residual;
      for (int axis = 0; axis < 3; ++axis) {
        if (!here.is_coarsened(axis)) continue;
        T* const to = here.is_last(axis) ? vectors.b : from == residual ? spare : residual;
        team.meet();
        restrict(here, axis, from, to);
        from = to;
      }
    }
    PRDP_NOINLINE void solve_coarsest(int level) {
      const T* const b = right_hand_side(level);
      const T* const inverse = cycle.numbers(cycle.grids().inverse);
      const int n = grid(level).points();
      const bool by_columns = transposed();
      T* const x = vectors.x;
      team.meet();
      team.for_each(kFields * n, [&](int at) {
        const int i = at % n;
        T sum = 0;
        PRDP_NO_UNROLL for (int j = 0; j < n; ++j) sum += inverse[by_columns ? j * n + i : i * n + j] * b[at - i + j];
        x[at] = sum;
      });
    }
    /// Adds the solution of the coarser grid to that of this one, smooths, and returns it.
    PRDP_NOINLINE const T* go_up(int level, const T* coarse) {
      vectors = level == 0 ? finest : vectors_of(level);
      if (level > 0 && swapped_on_the_way_down()) std::swap(vectors.x, vectors.y);  // `finest` was kept after the swaps
      const CoarseGrid& here = grid(level);
      for (int axis = 2; axis >= 0; --axis) {
        if (!here.is_coarsened(axis)) continue;
        T* const to = here.is_first(axis) ? vectors.x : coarse == spare ? vectors.y : spare;
        team.meet();
        interpolate(here, axis, coarse, to, /*adds=*/here.is_first(axis));
        coarse = to;
      }
      smooth(level, /*from_zero=*/false);
      return vectors.x;
    }

    // ---- on a grid

    /// Steps towards A x = b, from x = 0 with `from_zero`, else from x. y is scratch.
    PRDP_NOINLINE void smooth(int level, bool from_zero) {
      kernels::SmoothingSteps steps(grid(level).radius);
      for (int64_t s = 0; s < cycle.hierarchy.smoothing; ++s) {
        const kernels::SmoothingStep step = steps.next();
        if (from_zero && s == 0) {
          begin(level, static_cast<T>(step.q));
        } else {
          relax(level, static_cast<T>(step.p), static_cast<T>(step.q));
          std::swap(vectors.x, vectors.y);
        }
      }
    }
    /// x = q D⁻¹ b, and y = 0, the iterate before it.
    PRDP_NOINLINE void begin(int level, T q) {
      const T *const b = right_hand_side(level), *const diagonal = diagonals(level);
      T *const x = vectors.x, *const y = vectors.y;
      const int n = grid(level).points();
      team.for_each(kFields * n, [&](int i) {
        x[i] = q * (b[i] / diagonal[i % n]);
        y[i] = 0;
      });
    }
    /// y = b - A x
    void take_residual(int level) { relax(level, T(0), T(0)); }
    /// y = x + p (x - y) + q D⁻¹(b - A x); with q = 0, y = b - A x: products are most of what there is to compile, so
    /// there is one text of both.
    PRDP_NOINLINE void relax(int level, T p, T q) {
      if (level == 0) return relax(OnFinest{a, diagonals(0)}, r, A::kUnknowns, p, q);
      const CoarseGrid& here = grid(level);
      const int n = here.points();
      const OnCoarse coarse{
          {cycle.numbers(here.coefficients), {here.shape[0], here.shape[1], here.shape[2]}}, n, transposed()};
      relax(coarse, vectors.b, kFields * n, p, q);
    }
    template <class Level>
    PRDP_NOINLINE void relax(const Level& level, const T* b, int n, T p, T q) {
      const T* const x = vectors.x;
      T* const y = vectors.y;
      team.meet();
      team.for_each(n, [&](int i) {
        const T left = b[i] - level.product(x, i);
        if (q == T(0)) {
          y[i] = left;
          return;
        }
        // In the first step p is 0 and y holds no iterate: 0 (x - y) could be NaN.
        const T before = p == T(0) ? T(0) : p * (x[i] - y[i]);
        y[i] = x[i] + before + q * left / level.diagonal(i);
      });
    }

    // ---- between grids, along one axis

    PRDP_NOINLINE void restrict(const CoarseGrid& here, int axis, const T* fine, T* coarse) {
      const CoarsenedAxis line = line_of(here, axis);
      const Weights w = weights(here, axis, line, /*of_restriction=*/true);
      team.for_each(kFields * line.coarse_entries(),
                    [&](int i) { coarse[i] = line.restricted(fine, w.left, w.right, i); });
    }
    PRDP_NOINLINE void interpolate(const CoarseGrid& here, int axis, const T* coarse, T* fine, bool adds) {
      const CoarsenedAxis line = line_of(here, axis);
      const Weights w = weights(here, axis, line, /*of_restriction=*/false);
      team.for_each(kFields * line.fine_entries(), [&](int i) {
        const T value = line.interpolated(coarse, w.left, w.right, i);
        fine[i] = adds ? fine[i] + value : value;
      });
    }
    static CoarsenedAxis line_of(const CoarseGrid& grid, int axis) {
      int shape[3] = {grid.shape[0], grid.shape[1], grid.shape[2]};
      for (int d = 0; d < axis; ++d)
        if (grid.is_coarsened(d)) shape[d] = static_cast<int>(kernels::coarse_points(shape[d], A::periodic(d)));
      return {shape, axis, A::periodic(axis)};
    }
    /// Those of interpolation come first; of a symmetric operator they are those of restriction, too. The transpose of
    /// an operator restricts as the operator interpolates, and the other way round.
    Weights weights(const CoarseGrid& here, int axis, const CoarsenedAxis& line, bool of_restriction) const {
      const bool second = of_restriction != transposed() && !cycle.grids().is_symmetric;
      const T* const left = cycle.numbers(here.weights[axis]) + (second ? 2 * line.weights() : 0);
      return {left, left + line.weights()};
    }

    // ---- grids, and what is known on them

    const CoarseGrid& grid(int level) const { return cycle.grids().grid[level]; }
    bool transposed() const { return cycle.hierarchy.transposed != 0; }
    /// Whether smooth() from zero, which swaps x and y in every step but the first, has left them in each other's
    /// place.
    bool swapped_on_the_way_down() const { return cycle.hierarchy.smoothing % 2 == 0; }
    const T* right_hand_side(int level) const { return level == 0 ? r : vectors.b; }
    const T* diagonals(int level) const {
      return cycle.numbers(grid(level).coefficients) + int64_t{Stencil::kCentre} * grid(level).points();
    }
    /// The vectors of a coarse grid, which lie behind those of the grids above it, in the memory of the block as long
    /// as they fit. Either memory is indexed as if it held all of them.
    Vectors vectors_of(int level) const {
      int64_t place = 0;
      for (int above = 1; above < level; ++above) place += 3 * entries(above);
      const int64_t n = entries(level);
      T* const first = (place + 3 * n <= S::Cycles::kInBlock ? cycle.in_block : cycle.beyond) + place;
      return {first, first + n, first + 2 * n};
    }
    int64_t entries(int level) const { return int64_t{kFields} * grid(level).points(); }
  };
};

}  // namespace prdp::gpu
