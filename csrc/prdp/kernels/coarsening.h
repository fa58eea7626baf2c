#pragma once
#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

/// The rules of multigrid that its loops (multigrid.h) and its tensors (solvers/tensor_cycles.h) share.
namespace prdp::kernels {

/// The number of coarse points of an axis.
inline int64_t coarse_points(int64_t n, bool periodic) { return periodic ? (n + 1) / 2 : n / 2; }

/// How a stencil couples the points, summed over all or some of them.
struct Couplings {
  std::vector<double> along;  // for each axis, the magnitudes of the coefficients that reach along it
  /// The same of the sums of those that reach as far along the axis: what the other axes brought in cancels.
  std::vector<double> net;
  double rows;  // the magnitudes of the sums of rows, within the grid
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
/// strongest one. But where the points of a short axis are coupled so much more than those of a longer one, and nothing
/// holds their constant, such as a value on the boundary, what is constant along the short axis is neither smoothed nor
/// coarsened: that axis is coarsened as well, down to one point. `net` and `rows` are needed if may_need_one_point().
template <class Shape>
std::vector<int> axes_to_coarsen(const Shape& shape, const Couplings& couplings) {
  constexpr double weak = 0.25, held = 3.0 / 16.0;
  const int dim = static_cast<int>(couplings.along.size());
  std::vector<int> candidates;
  for (int d = 0; d < dim; ++d)
    if (shape[d] > kCoarsest) candidates.push_back(d);
  const auto* coupling = &couplings.along;
  if (may_need_one_point(shape, dim)) {
    double weakest = std::numeric_limits<double>::infinity();
    for (const int d : candidates) weakest = std::min(weakest, couplings.net[d]);
    for (int d = 0; d < dim; ++d) {
      const double own = couplings.net[d];
      if (shape[d] == 1 || shape[d] > kCoarsest || weakest >= weak * own || couplings.rows >= held * own) continue;
      candidates.push_back(d);
      coupling = &couplings.net;
    }
    std::sort(candidates.begin(), candidates.end());
  }
  double strongest = 0;
  for (const int d : candidates) strongest = std::max(strongest, (*coupling)[d]);
  std::erase_if(candidates, [&](int d) { return (*coupling)[d] < weak * strongest; });
  return candidates;
}

/// A coarse diagonal below this many roundings of the fine one is what was left of a pocket that the coarse grid does
/// not resolve; where nothing couples to the point, roundings of the whole pocket may have gathered there. The fine
/// diagonal is kept in its place: there is nothing to correct, and nothing is divided by it.
inline constexpr double kVanishing = 8.0, kVanishingAlone = 256.0;

/// A step x ← x + p (x - x₋) + q D⁻¹(b - A x) of Chebyshev's iteration over [ρ/4, ρ].
struct SmoothingStep {
  double p, q;
};
inline std::vector<SmoothingStep> smoothing_steps(double radius, int64_t count) {
  constexpr double ratio = 4.0;
  const double middle = (radius + radius / ratio) / 2, half = (radius - radius / ratio) / 2, sigma = middle / half;
  std::vector<SmoothingStep> steps{{0.0, 1.0 / middle}};
  double rho = 1.0 / sigma;
  for (int64_t s = 1; s < count; ++s) {
    const double next = 1.0 / (2.0 * sigma - rho);
    steps.push_back({next * rho, 2.0 * next / half});
    rho = next;
  }
  return steps;
}

}  // namespace prdp::kernels
