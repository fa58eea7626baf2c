#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

/// The rules of multigrid that its loops (multigrid.h) and its kernels (gpu/device/hierarchy.h) share.
namespace prdp::kernels {

/// The number of coarse points of an axis.
inline int64_t coarse_points(int64_t n, bool periodic) { return periodic ? (n + 1) / 2 : n / 2; }

/// How a stencil couples the points, summed over all or some of them.
struct Couplings {
  double along[3] = {0, 0, 0};  // for each axis, the magnitudes of the coefficients that reach along it
  /// The same of the sums of those that reach as far along the axis: what the other axes brought in cancels.
  double net[3] = {0, 0, 0};
  double rows = 0;  // the magnitudes of the sums of rows, within the grid
};

/// Axes of a grid, in their order.
struct Axes {
  int count = 0, axis[3] = {0, 0, 0};

  void add(int d) { axis[count++] = d; }
  bool empty() const { return count == 0; }
  int front() const { return axis[0]; }
  const int* begin() const { return axis; }
  const int* end() const { return axis + count; }
};

constexpr int64_t kCoarsest = 4;  // points of an axis

/// Whether an axis that is as short as any needs to be is yet to be coarsened, where others are longer.
template <class Shape>
bool may_need_one_point(const Shape& shape, int dim) {
  bool is_short = false, is_long = false;
  for (int d = 0; d < dim; ++d) {
    is_short = is_short || (shape[d] > 1 && shape[d] <= kCoarsest);
    is_long = is_long || shape[d] > kCoarsest;
  }
  return is_short && is_long;
}

/// The axes along which to coarsen: those of more than four points whose coupling is at least a quarter of the
/// strongest one. Exception: a short axis whose coupling is four times that of a long one, with nothing such as a
/// boundary value to fix its constant. A vector that is constant along it is neither smoothed nor coarsened, so this
/// axis is coarsened too, to one point. `net` and `rows` are needed if may_need_one_point().
template <class Shape>
Axes axes_to_coarsen(const Shape& shape, int dim, const Couplings& couplings) {
  constexpr double weak = 0.25, held = 3.0 / 16.0;
  bool is_candidate[3] = {false, false, false};
  for (int d = 0; d < dim; ++d) is_candidate[d] = shape[d] > kCoarsest;
  const double* coupling = couplings.along;
  if (may_need_one_point(shape, dim)) {
    double weakest = std::numeric_limits<double>::infinity();
    for (int d = 0; d < dim; ++d)
      if (is_candidate[d]) weakest = std::min(weakest, couplings.net[d]);
    for (int d = 0; d < dim; ++d) {
      const double own = couplings.net[d];
      if (shape[d] == 1 || shape[d] > kCoarsest || weakest >= weak * own || couplings.rows >= held * own) continue;
      is_candidate[d] = true;
      coupling = couplings.net;
    }
  }
  double strongest = 0;
  for (int d = 0; d < dim; ++d)
    if (is_candidate[d]) strongest = std::max(strongest, coupling[d]);
  Axes axes;
  for (int d = 0; d < dim; ++d)
    if (is_candidate[d] && !(coupling[d] < weak * strongest)) axes.add(d);
  return axes;
}

/// A coarse diagonal below this many ε of the fine one is cancellation error, of a region that the coarse grid does not
/// resolve; where nothing couples to the point, the errors of the whole region may have gathered there: `is_alone()`,
/// asked where it decides. The fine diagonal is kept in its place: there is nothing to correct, and nothing is divided
/// by it.
template <class T, class IsAlone>
T kept_diagonal(T coarse, T fine, const IsAlone& is_alone) {
  constexpr T rounding = std::numeric_limits<T>::epsilon(), vanishing = T(8) * rounding, alone = T(256) * rounding;
  const T size = std::abs(coarse);
  if (size > alone * std::abs(fine)) return coarse;
  return size <= vanishing * std::abs(fine) || is_alone() ? fine : coarse;
}

/// A step x ← x + p (x - x₋) + q D⁻¹(b - A x) of Chebyshev's iteration over [ρ/4, ρ].
struct SmoothingStep {
  double p, q;
};
/// These steps, one after the other.
class SmoothingSteps {
  static constexpr double kRatio = 4.0;

 public:
  explicit SmoothingSteps(double radius)
      : middle_((radius + radius / kRatio) / 2), half_((radius - radius / kRatio) / 2), sigma_(middle_ / half_) {}

  SmoothingStep next() {
    if (is_first_) {
      is_first_ = false;
      rho_ = 1.0 / sigma_;
      return {0.0, 1.0 / middle_};
    }
    const double before = rho_;
    rho_ = 1.0 / (2.0 * sigma_ - before);
    return {rho_ * before, 2.0 * rho_ / half_};
  }

 private:
  double middle_, half_, sigma_, rho_ = 0;
  bool is_first_ = true;
};

/// What a point between two coarse ones takes of them, by the sums of its coefficients with offset -1, 0 and 1 along
/// the axis. Where the neighbours outweigh the point, as in the columns of A where winds meet, the weights are made to
/// add up to one.
template <class T>
struct WeightsOfPoint {
  T left, right;

  WeightsOfPoint(T diagonal, T sum_before, T sum, T sum_after) {
    const T sign = diagonal < T(0) ? T(-1) : T(1);
    const T before = std::max(-sign * sum_before, T(0)), after = std::max(-sign * sum_after, T(0));
    const T whole = std::max(sign * sum, before + after);
    left = whole > T(0) ? before / whole : T(0);
    right = whole > T(0) ? after / whole : T(0);
  }
};

/// How many parts of at least two points there are that nothing couples to each other, where bit j of of_row[i] says
/// whether there is an entry (i, j), and bit i of of_column[j] too. For the coarsest grid, which has n <= 64 points.
inline int count_parts(int n, const uint64_t* of_row, const uint64_t* of_column) {
  uint64_t seen = 0;
  int parts = 0;
  for (int first = 0; first < n; ++first) {
    if (seen >> first & 1) continue;
    uint64_t part = uint64_t{1} << first, before = 0;
    while (part != before) {
      before = part;
      for (int i = first; i < n; ++i)
        if (part >> i & 1) part |= of_row[i] | of_column[i];
    }
    seen |= part;
    parts += (part & (part - 1)) != 0;
  }
  return parts;
}

}  // namespace prdp::kernels
