#pragma once
#include <array>
#include <cmath>
#include <cstdint>
#include <numbers>

namespace prdp::kernels {

/// A v = centre·v + Σ_d off_d (v_{i-1} + v_{i+1} along d), zero outside the grid. The axes are in
/// tensor order and fill the front of the arrays: (nx), (ny, nx) or (nz, ny, nx).
struct LaplacianParameters {
  int64_t dim = 0;
  std::array<int64_t, 3> shape{1, 1, 1};
  double centre = 0.0;
  std::array<double, 3> off{};
};

/// The spectral radius of I - D⁻¹A. Its eigenvalues come in pairs ±μ.
inline double jacobi_radius(const LaplacianParameters& a) {
  double sum = 0;
  for (int64_t d = 0; d < a.dim; ++d)
    sum += 2 * std::abs(a.off[d]) * std::cos(std::numbers::pi / static_cast<double>(a.shape[d] + 1));
  return sum / std::abs(a.centre);
}

}  // namespace prdp::kernels
