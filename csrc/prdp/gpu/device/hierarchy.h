#pragma once
#include "prdp/gpu/device/coarse_grid.h"
#include "prdp/gpu/device/diffusion.h"
#include "prdp/gpu/device/pseudo_inverse.h"
#include "prdp/gpu/device/team.h"
#include "prdp/gpu/device/upwind.h"
#include "prdp/kernels/galerkin_point.h"

/// The coarse grids of multigrid with their operators, as kernels/hierarchy.cpp and kernels/galerkin.cpp make them on
/// the CPU: one launch for all samples, each by a team that sees nothing of the others.
namespace prdp::gpu {

/// Constants of a kernel.
template <class Number, class Operator, int dimensions, int blocks, int threads>
struct HierarchySetting {
  using T = Number;
  using A = typename Operator::Cycled;     // of the views of operators
  static constexpr int kDim = dimensions;  // of the grid
  static constexpr int kBlocks = blocks;   // that work on one sample
  static constexpr int kThreads = threads;
};

template <class S>
class HierarchyMaker {
  using T = typename S::T;
  using A = typename S::A;
  using Stencil = GridStencil<T, A, S::kDim>;
  using TeamOfSample = Team<S::kBlocks, S::kThreads>;
  static constexpr int kOffsets = Stencil::kOffsets, kCentre = Stencil::kCentre, kFirstAxis = 3 - S::kDim;

 public:
  HierarchyMaker(TeamOfSample& team, const HierarchyArguments<T>& of, int64_t sample, double* work)
      : team_(team),
        grids_(of.grids[sample]),
        numbers_(of.numbers + sample * of.numbers_of_sample),
        nullity_(static_cast<int>(of.nullities ? of.nullities[sample] : of.nullity)),
        work_(work) {}

  void make(A a) {
    const int64_t count = make_grids(a);
    if (team_.leads()) grids_.count = count;
  }

 private:
  /// How many grids there are; 0 if a number is not finite, a diagonal is zero, there are too many grids, or the
  /// coarsest has too many points or no inverse.
  int64_t make_grids(A& a) {
    if (!scale_operator<T>(team_, a)) return 0;
    Stencil stencil = finest(a);
    for (int level = 0; level < kMostGrids; ++level) {
      const double radius = gershgorin_bound(stencil);
      if (!std::isfinite(radius)) return 0;
      if (level == 0) symmetric_ = is_symmetric(stencil);
      const kernels::Axes axes = axes_to_coarsen(stencil);
      CoarseGrid grid{
          {stencil.shape[0], stencil.shape[1], stencil.shape[2]}, 0, stencil.coefficients - numbers_, {}, radius};
      Stencil next = stencil;
      for (const int axis : axes) {
        grid.axes |= 1 << axis;
        grid.weights[axis] = used_;
        next = galerkin_product(next, axis);
      }
      if (team_.leads()) grids_.grid[level] = grid;
      if (axes.empty()) {
        if (team_.leads()) grids_.is_symmetric = symmetric_;
        return invert_coarsest(stencil) ? level + 1 : 0;
      }
      stencil = next;
    }
    return 0;
  }

  /// The next n of the numbers of this sample.
  T* take(int64_t n) {
    T* const taken = numbers_ + used_;
    used_ += n;
    return taken;
  }

  /// The coefficients of A itself.
  PRDP_NOINLINE Stencil finest(const A& a) {
    Stencil made{nullptr, {A::Points::kZ, A::Points::kY, A::Points::kX}};
    constexpr int n = A::Points::kPoints;
    T* const to = take(int64_t{kOffsets} * n);
    const T factor = A::kIsScaled ? T(1) : a.factor();  // a view that always is gives its entries so
    team_.for_each(n, [&](int i) {
      for (int k = 0; k < kOffsets; ++k) to[k * n + i] = 0;
      a.for_each_offset(i, [&](T value, int dz, int dy, int dx) {
        if ((S::kDim < 3 && dz != 0) || (S::kDim < 2 && dy != 0)) return;
        to[Stencil::place(dz, dy, dx) * n + i] += factor * value;
      });
    });
    made.coefficients = to;
    return made;
  }

  /// To the last bit. It needs no barrier first: gershgorin_bound() has met since the coefficients were written.
  PRDP_NOINLINE bool is_symmetric(const Stencil& a) {
    const int n = a.points();
    const T* const entry = a.coefficients;
    T differs = 0;
    team_.for_each(n, [&](int i) {
      a.for_each_neighbour(i, [&](int k, int there) {
        if (there >= 0 && entry[k * n + i] != entry[(kOffsets - 1 - k) * n + there]) differs = 1;
      });
    });
    return team_.largest(differs) == T(0);
  }

  /// Σ_k |a_k| / |a_0|, the largest of all points; infinite where a diagonal is zero, or a number is not finite.
  PRDP_NOINLINE double gershgorin_bound(const Stencil& a) {
    const int n = a.points();
    const T* const entry = a.coefficients;
    return static_cast<double>(largest_of(team_, n, [&](int i) {
      T sum = 0;
      for (int k = 0; k < kOffsets; ++k) sum += std::abs(entry[k * n + i]);
      return sum / std::abs(entry[kCentre * n + i]);
    }));
  }

  /// Estimated from at most 8,191 of the points, an odd number apart, so that no axis shows the same places alone.
  PRDP_NOINLINE kernels::Axes axes_to_coarsen(const Stencil& a) {
    const int n = a.points(), step = (n / 4096 > 1 ? n / 4096 : 1) | 1;
    const T* const entry = a.coefficients;
    double along[4] = {}, net[4] = {};  // of each axis; and of the rows
    team_.for_each((n + step - 1) / step, [&](int place) {
      const int i = place * step;
      double sides[3][2] = {}, row = 0;
      a.for_each_neighbour(i, [&](int k, int there) {
        const double value = static_cast<double>(entry[k * n + i]);
        for (int axis = kFirstAxis; axis < 3; ++axis) {
          const int cells = k / Stencil::step(axis) % 3 - 1;
          if (cells == 0) continue;
          along[axis] += std::abs(value);
          sides[axis][cells > 0] += value;
        }
        if (there >= 0) row += value;
      });
      for (int axis = kFirstAxis; axis < 3; ++axis) net[axis] += std::abs(sides[axis][0]) + std::abs(sides[axis][1]);
      net[3] += std::abs(row);
    });
    team_.sum(along);
    team_.sum(net);
    const kernels::Couplings couplings{{along[0], along[1], along[2]}, {net[0], net[1], net[2]}, net[3]};
    return kernels::axes_to_coarsen(a.shape, 3, couplings);
  }

  /// The weights of the axis, which are kept, and the operator on the coarse points.
  PRDP_NOINLINE Stencil galerkin_product(const Stencil& a, int axis) {
    const CoarsenedAxis line(a.shape, axis, A::periodic(axis));
    T* const weights = take(int64_t{symmetric_ ? 2 : 4} * line.weights());
    make_weights(a, line, axis, weights);
    Stencil coarse = a;
    coarse.shape[axis] = line.coarse;
    T* const to = take(int64_t{kOffsets} * coarse.points());
    coarse.coefficients = to;
    team_.meet();
    team_.for_each(coarse.points(), [&](int i) { make_coarse_point(a, line, axis, weights, i, coarse.points(), to); });
    team_.meet();
    return coarse;
  }

  /// The fine point of weight w: it lies between two coarse ones.
  static int point_of_weight(const CoarsenedAxis& line, int w) {
    const int row = w / line.inner, at = line.of_between(row % line.between());
    return line.entry_of(row / line.between(), at, line.n, w % line.inner);
  }

  /// Of a symmetric operator, interpolation and restriction are the same; else interpolation comes from the symmetric
  /// part and restriction from the transpose (Dendy 1983). Writes fields of line.weights() numbers: those of
  /// interpolation from the left and the right; and where A is not symmetric, those of restriction.
  PRDP_NOINLINE void make_weights(const Stencil& a, const CoarsenedAxis& line, int axis, T* to) {
    const int n = a.points(), weights = line.weights();
    const T* const entry = a.coefficients;
    team_.for_each(weights, [&](int w) {
      const int i = point_of_weight(line, w);
      T own[3] = {}, of_transpose[3] = {};
      a.for_each_neighbour(i, [&](int k, int there) {
        const int d = k / Stencil::step(axis) % 3;
        const T value = entry[k * n + i];
        own[d] += value;
        // Aᵀ couples i to its neighbour as A couples that to i. Beyond the grid, A's own coefficient stands for it.
        if (!symmetric_) of_transpose[d] += there < 0 ? value : entry[(kOffsets - 1 - k) * n + there];
      });
      const T diagonal = entry[kCentre * n + i];
      if (!symmetric_)
        for (int d = 0; d < 3; ++d) own[d] += of_transpose[d];
      const kernels::WeightsOfPoint<T> interpolation(diagonal, own[0], own[1], own[2]);
      to[w] = interpolation.left;
      to[weights + w] = interpolation.right;
      if (symmetric_) return;
      const kernels::WeightsOfPoint<T> restriction(diagonal, of_transpose[0], of_transpose[1], of_transpose[2]);
      to[2 * weights + w] = restriction.left;
      to[3 * weights + w] = restriction.right;
    });
  }

  /// f(place, offset) for each offset in the axes other than `axis`.
  template <class F>
  static void for_each_column(int axis, const F& f) {
    const auto reach = [axis](int d) { return d != axis && d >= kFirstAxis ? 1 : 0; };
    for (int dz = -reach(0); dz <= reach(0); ++dz)
      for (int dy = -reach(1); dy <= reach(1); ++dy)
        for (int dx = -reach(2); dx <= reach(2); ++dx) f(Stencil::place(dz, dy, dx), {dz, dy, dx});
  }

  /// From fine point `fine`, go by `offset` in the other axes, and along the axis to point `between`: the index of the
  /// weights there; -1 beyond the grid.
  static int weight_of_column(const Stencil& a, const CoarsenedAxis& line, int axis, int fine, const int (&offset)[3],
                              int between) {
    const int point[3] = {fine / (a.shape[1] * a.shape[2]), fine / a.shape[2] % a.shape[1], fine % a.shape[2]};
    int index = 0;
    for (int d = 0; d < 3; ++d) {
      const int at = d == axis ? between : moved(point[d], offset[d], a.shape[d], A::periodic(d));
      if (at < 0) return -1;
      index = index * (d == axis ? line.between() : a.shape[d]) + at;
    }
    return index;
  }

  /// The weights by which a coarse point meets the column of fine points at this offset.
  kernels::GalerkinPoint<T> weights_of_column(const Stencil& a, const CoarsenedAxis& line, int axis, const T* weights,
                                              const CoarsePoint& at, const int (&offset)[3]) const {
    const int of_left = 0, of_right = line.weights(), restriction = symmetric_ ? 0 : 2 * line.weights();
    const auto restrict_by = [&](int field, int between) {
      return weights[restriction + field + line.weight_of(at.outer, between, at.inner)];
    };
    const auto interpolate_by = [&](int field, int between) {
      const int index = weight_of_column(a, line, axis, at.fine[1], offset, between);
      return index < 0 ? T(0) : weights[field + index];
    };
    kernels::GalerkinPoint<T> made;
    if (at.before >= 0) {
      made.before_left = interpolate_by(of_left, at.before);
      made.before_right = interpolate_by(of_right, at.before);
      made.restrict_before = restrict_by(of_right, at.before);
    }
    if (at.after >= 0) {
      made.after_left = interpolate_by(of_left, at.after);
      made.after_right = interpolate_by(of_right, at.after);
      made.restrict_after = restrict_by(of_left, at.after);
    }
    return made;
  }

  /// All coefficients of coarse point i: R A P, for each column of neighbours.
  void make_coarse_point(const Stencil& a, const CoarsenedAxis& line, int axis, const T* weights, int i, int points,
                         T* to) const {
    const CoarsePoint at(line, i);
    const int n = a.points();
    const T* const entry = a.coefficients;
    const auto coefficient = [&](int place, int p) { return entry[place * n + at.fine[p]]; };
    for_each_column(axis, [&](int centre, const int (&offset)[3]) {
      auto made = weights_of_column(a, line, axis, weights, at, offset);
      const int lower = centre - Stencil::step(axis), upper = centre + Stencil::step(axis);
      made.take_centres(coefficient(centre, 0), coefficient(centre, 1), coefficient(centre, 2));
      made.take_sides({coefficient(lower, 0), coefficient(lower, 1), coefficient(lower, 2)},
                      {coefficient(upper, 0), coefficient(upper, 1), coefficient(upper, 2)});
      const bool is_alone = line.periodic && line.coarse == 1;  // and its own neighbour
      to[lower * points + i] = is_alone ? T(0) : made.left;
      to[centre * points + i] = is_alone ? made.centre + made.left + made.right : made.centre;
      to[upper * points + i] = is_alone ? T(0) : made.right;
    });
    keep_vanishing_diagonal(coefficient(kCentre, 1), i, points, to);
  }
  /// See kernels::kept_diagonal().
  static void keep_vanishing_diagonal(T fine, int i, int points, T* to) {
    const auto is_alone = [&] {
      for (int k = 0; k < kOffsets; ++k)
        if (k != kCentre && to[k * points + i] != T(0)) return false;
      return true;
    };
    T& diagonal = to[kCentre * points + i];
    diagonal = kernels::kept_diagonal(diagonal, fine, is_alone);
  }

  /// Whether it could be inverted, or where it is singular within the nullity, pseudo-inverted.
  PRDP_NOINLINE bool invert_coarsest(const Stencil& a) {
    const int n = a.points();
    if (n > kMostOfCoarsest) return false;
    T* const inverse = take(int64_t{n} * n);
    if (team_.leads()) grids_.inverse = inverse - numbers_;
    T largest = 0;
    if (team_.is_first_block()) {
      const T* const entry = a.coefficients;
      for (int i = static_cast<int>(threadIdx.x); i < n; i += S::kThreads) {
        for (int j = 0; j < n; ++j) work_[i * n + j] = 0;
        a.for_each_neighbour(i, [&](int k, int there) {
          if (there >= 0) work_[i * n + there] += static_cast<double>(entry[k * n + i]);
        });
      }
      const double tiny = 10.0 * n * static_cast<double>(std::numeric_limits<T>::epsilon());
      largest = pseudo_inverse<S::kThreads>(n, work_, nullity_, tiny, inverse);
    }
    return std::isfinite(team_.largest(largest));
  }

  TeamOfSample& team_;
  Grids& grids_;
  T* numbers_;
  int nullity_;
  double* work_;
  int64_t used_ = 0;
  bool symmetric_ = true;  // the operator; interpolation and restriction then have the same weights
};

/// The body of a kernel.
template <class S>
void make_hierarchies(const HierarchyArguments<typename S::T>& of) {
  for_samples_of_team<S::kBlocks, S::kThreads>(of, of.samples, [&](int64_t sample, auto& team, int number) {
    HierarchyMaker<S> maker(team, of, sample, of.work + numbers_of_inverse(kMostOfCoarsest) * number);
    maker.make(typename S::A(of.a, sample));
  });
}

}  // namespace prdp::gpu
