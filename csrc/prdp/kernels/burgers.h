#pragma once
#include "prdp/kernels/assembly.h"
#include "prdp/kernels/stencil.h"
#include "prdp/kernels/upwind_rows.h"

namespace prdp::kernels {

/// I + dt Γ(w) - ν dt L on each of the `dim` channels, with the winds averaged to the faces; null where a wind is not
/// finite.
template <class T>
std::unique_ptr<Kernel<T>> burgers(const UpwindParameters<T>& p, int64_t dim) {
  if (!std::isfinite(p.largest_wind(dim))) return nullptr;
  const double factor = scale_of_operator(p.magnitude(dim, 1.0, p.dt, p.nu * p.dt));
  const auto wind = [&p](int64_t channel, int64_t j) { return p.winds + (channel * p.ny + j) * p.nx; };
  const auto winds = [&](int axis, int64_t j, T* scratch) -> WindRow<T> {
    if (axis == 1) return {wind(1, j > 0 ? j - 1 : p.ny - 1), wind(1, j), wind(1, j + 1 < p.ny ? j + 1 : 0)};
    const T* w = wind(0, j);
    scratch[0] = w[p.nx - 1];
    std::copy(w, w + p.nx, scratch + 1);
    scratch[p.nx + 1] = w[0];
    return {scratch, scratch + 1, scratch + 2};
  };
  UpwindTerms terms{factor, p.dt * factor, p.nu * p.dt * factor, p.transposed, p.length_y, p.length_x};
  auto rows = std::make_shared<PackedStencil<T>>(upwind_rows<T>(p.pattern, terms, winds));
  const auto as_fields = [p, dim]() -> std::optional<StencilFields<T>> {
    auto untransposed = p;
    untransposed.transposed = false;
    const auto kernel = burgers(untransposed, dim);
    return fields_of(dynamic_cast<const Stencil<T>&>(*kernel).coefficients());
  };
  return std::make_unique<Stencil<T>>(
      std::move(rows), dim, static_cast<T>(factor),
      typename Stencil<T>::Source{[p, dim] { return p.key(dim); }, as_fields, p.transposed});
}

}  // namespace prdp::kernels
