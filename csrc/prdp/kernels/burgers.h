#pragma once
#include "prdp/kernels/stencil.h"
#include "prdp/kernels/upwind_rows.h"

namespace prdp::kernels {

/// I + dt Γ(w) - ν dt L on each of the `dim` channels, with the winds averaged to the faces.
template <class T>
Stencil<T> burgers(const UpwindParameters<T>& parameters, int64_t dim) {
  const auto pattern = parameters.pattern(dim);
  const auto assemble = [parameters, pattern, dim](int64_t s) -> std::optional<StencilRows<T>> {
    const auto p = parameters.sample(s);
    if (!p.is_finite(dim)) return std::nullopt;
    const auto wind = [&p](int64_t channel, int64_t j) { return p.winds + (channel * p.ny + j) * p.nx; };
    const auto winds = [&](int axis, int64_t j, T* scratch) -> WindRow<T> {
      if (axis == 1) return {wind(1, j > 0 ? j - 1 : p.ny - 1), wind(1, j), wind(1, j + 1 < p.ny ? j + 1 : 0)};
      const T* w = wind(0, j);
      scratch[0] = w[p.nx - 1];
      std::copy(w, w + p.nx, scratch + 1);
      scratch[p.nx + 1] = w[0];
      return {scratch, scratch + 1, scratch + 2};
    };
    const UpwindTerms terms{1.0, p.dt, p.nu * p.dt, p.transposed, p.length_y, p.length_x};
    return upwind_rows<T>(pattern, terms, winds);
  };
  return {pattern->grid, dim, parameters.is_shared(), assemble};
}

}  // namespace prdp::kernels
