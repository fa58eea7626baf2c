#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

/// The rules of multigrid that its loops (multigrid.h) and its tensors (solvers/tensor_cycles.h) share.
namespace prdp::kernels {

/// The number of coarse points of an axis.
inline int64_t coarse_points(int64_t n, bool periodic) { return periodic ? (n + 1) / 2 : n / 2; }

/// The axes along which to coarsen: those of more than four points whose coupling, the sum of the magnitudes of
/// coefficients that reach along it, is at least a quarter of the strongest one.
template <class Shape, class Couplings>
std::vector<int> axes_to_coarsen(const Shape& shape, const Couplings& couplings) {
  constexpr int64_t coarsest = 4;
  constexpr double weak = 0.25;
  const int dim = static_cast<int>(std::size(couplings));
  double strongest = 0;
  for (int d = 0; d < dim; ++d)
    if (shape[d] > coarsest) strongest = std::max(strongest, couplings[d]);
  std::vector<int> axes;
  for (int d = 0; d < dim; ++d)
    if (shape[d] > coarsest && couplings[d] >= weak * strongest) axes.push_back(d);
  return axes;
}

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
