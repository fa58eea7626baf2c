#pragma once
#include <array>
#include <cstdint>

namespace prdp::kernels {

/// A v = centre·v + Σ_d off_d (v_{i-1} + v_{i+1} along d), zero outside the grid. The axes are in
/// tensor order and fill the front of the arrays: (nx), (ny, nx) or (nz, ny, nx).
struct LaplacianParameters {
  int64_t dim = 0;
  std::array<int64_t, 3> shape{1, 1, 1};
  double centre = 0.0;
  std::array<double, 3> off{};
};

}  // namespace prdp::kernels
