#pragma once
#include <algorithm>

#include "prdp/kernels/factor_cache.h"
#include "prdp/kernels/packed_stencil.h"

namespace prdp::kernels {

/// An operator that depends on a velocity field, as plain arrays: the winds (channel, ny, nx) of one sample on a
/// periodic grid; ny = 1 in one dimension.
template <class T>
struct UpwindParameters {
  const T* winds;
  int64_t ny, nx;
  double nu, dt;
  bool transposed;
  double length_y = 1.0, length_x = 1.0;         // of the domain
  std::shared_ptr<const StencilSparsity> pattern;  // of_grid(), made once for a batch

  static std::shared_ptr<const StencilSparsity> of_grid(int64_t dim, int64_t ny, int64_t nx) {
    return std::make_shared<StencilSparsity>(StencilGrid{dim, {1, ny, nx}, {true, true, true}},
                                             StencilSparsity::nearest_neighbours(dim));
  }
  /// NaN or Inf where a wind is: max(w, 0) would lose it.
  T largest_wind(int64_t channels) const { return largest_magnitude(winds, channels * ny * nx); }
  /// A bound of the entries of shift·I + advection·Γ - diffusion·L, up to a factor of some ten.
  double magnitude(int64_t dim, double shift, double advection, double diffusion) const {
    const double x = static_cast<double>(nx) / length_x, y = dim > 1 ? static_cast<double>(ny) / length_y : 0.0;
    const auto wind = static_cast<double>(largest_wind(dim));
    return std::max({shift, advection * wind * std::max(x, y), diffusion * std::max(x * x, y * y)});
  }
  /// Tells the operator from others of its kind, the same for its transpose.
  FactorKey key(int64_t channels) const {
    FactorKeyMaker key;
    return key.add(ny).add(nx).add(nu).add(dt).add(length_y).add(length_x).add(winds, channels * ny * nx).key();
  }
};

/// The winds that act along one axis on one row of the grid: at its points and to either side of them,
/// each nx values.
template <class T>
struct WindRow {
  const T *before, *here, *after;
};

/// shift·I + advection·Γ - diffusion·L of one scalar field, or its transpose.
struct UpwindTerms {
  double shift, advection, diffusion;
  bool transposed;
  double length_y = 1.0, length_x = 1.0;
};

/// Its coefficients on a periodic grid: upwind differences Γ = Σ diag(max(w⁻, 0)) B + diag(min(w⁺, 0)) F and
/// the Laplacian L. Along an axis of one point all differences vanish. `winds(axis, j, scratch)` is the
/// WindRow along the axis (0: x, 1: y) at row j; it may lie in scratch, which holds nx + 2 values.
template <class T, class Winds>
PackedStencil<T> upwind_rows(std::shared_ptr<const StencilSparsity> pattern, const UpwindTerms& terms,
                             const Winds& winds) {
  PackedStencil<T> a(std::move(pattern));
  const auto& loops = kernels::loops<T>();
  const int64_t ny = a.grid().shape[1], nx = a.grid().shape[2];
  std::vector<T> scratch(3 * nx + 2);
  T *const lower = scratch.data(), *const upper = lower + nx, *const winds_memory = upper + nx;
  const double inverse_dx = static_cast<double>(nx) / terms.length_x;
  const double inverse_dy = static_cast<double>(ny) / terms.length_y;
  for (int64_t j = 0; j < ny; ++j) {
    const auto couple = [&](int axis, double inverse_width, T* below, T* above) {
      const WindRow<T> w = winds(axis, j, winds_memory);
      loops.upwind_row(static_cast<T>(terms.advection * inverse_width),
                       static_cast<T>(terms.diffusion * inverse_width * inverse_width), w.before, w.here, w.after,
                       below, above, a.coefficient(j, 0), nx);
    };
    std::fill_n(a.coefficient(j, 0), nx, static_cast<T>(terms.shift));
    // What couples a point to its neighbour belongs to the neighbour in the transpose.
    if (nx > 1 && !terms.transposed) couple(0, inverse_dx, a.coefficient(j, 1), a.coefficient(j, 2));
    if (nx > 1 && terms.transposed) {
      couple(0, inverse_dx, lower, upper);
      std::rotate_copy(upper, upper + nx - 1, upper + nx, a.coefficient(j, 1));
      std::rotate_copy(lower, lower + 1, lower + nx, a.coefficient(j, 2));
    }
    if (ny == 1) continue;
    const int64_t below = j > 0 ? j - 1 : ny - 1, above = j + 1 < ny ? j + 1 : 0;
    if (terms.transposed) couple(1, inverse_dy, a.coefficient(below, 4), a.coefficient(above, 3));
    else couple(1, inverse_dy, a.coefficient(j, 3), a.coefficient(j, 4));
  }
  a.close();
  return a;
}

}  // namespace prdp::kernels
