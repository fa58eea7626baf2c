#pragma once
#include "prdp/kernels/stencil.h"

namespace prdp::kernels {

/// A run of points along an axis: `count` points from index `to` on take the values of those
/// from index `from` on.
struct Run {
  int64_t to, from, count;
};

/// The coefficients of the points that have a neighbour at `offset`: their own or, in the transpose, those of the
/// neighbour.
inline std::array<Run, 2> runs(int64_t offset, int64_t n, bool periodic, bool transposed) {
  if (periodic && (!transposed || offset == 0)) return {{{0, 0, n}}};
  const int64_t begin = std::max<int64_t>(-offset, 0);
  const Run inner{begin, transposed ? begin + offset : begin, n - std::abs(offset)};
  if (!periodic) return {inner};
  return {{inner, offset > 0 ? Run{n - offset, 0, offset} : Run{0, n + offset, -offset}}};
}

/// The stencil with `coefficients` (batch, k, nz, ny, nx) for the offsets that `pattern` was given, or its
/// transpose: the stencil of the opposite offsets, of which `pattern` is then to be.
template <class T>
struct GivenStencil {
  const T* coefficients;
  int64_t sample_stride;  // 0: all samples share them
  std::shared_ptr<const StencilPattern> pattern;
  bool transposed;

  std::optional<StencilRows<T>> assemble(int64_t s) const {
    const auto& [nz, ny, nx] = pattern->grid.shape;
    const int64_t points = nz * ny * nx, given = static_cast<int64_t>(pattern->places.size());
    const T* from = coefficients + s * sample_stride;
    if (!std::isfinite(largest_magnitude(from, given * points))) return std::nullopt;
    StencilRows<T> a(pattern);
    std::vector<bool> holds(pattern->offsets.size());
    for (const int64_t k : pattern->places) {
      if (k >= 0) {
        add(a, k, from, holds[k]);
        holds[k] = true;
      }
      from += points;
    }
    a.close();
    return a;
  }

 private:
  /// Adds `from` (nz, ny, nx) to coefficient k, which is zero unless `holds`.
  void add(StencilRows<T>& a, int64_t k, const T* from, bool holds) const {
    const auto& [nz, ny, nx] = pattern->grid.shape;
    const auto along = [&](int axis) {
      return runs(pattern->offsets[k].along[axis], pattern->grid.shape[axis], pattern->grid.periodic[axis], transposed);
    };
    const auto& loops = kernels::loops<T>();
    for (const Run& z : along(0))
      for (int64_t plane = 0; plane < z.count; ++plane)
        for (const Run& y : along(1))
          for (const Run& x : along(2)) {
            if (y.count == 0 || x.count == 0) continue;
            T* to = a.coefficient((z.to + plane) * ny + y.to, k) + x.to;
            const T* source = from + ((z.from + plane) * ny + y.from) * nx + x.from;
            if (!holds) {
              loops.copy_rows(T(1), source, nx, to, a.stride(), y.count, x.count);
            } else {
              for (int64_t r = 0; r < y.count; ++r)
                for (int64_t i = 0; i < x.count; ++i) to[r * a.stride() + i] += source[r * nx + i];
            }
          }
  }
};

template <class T>
Stencil<T> given_stencil(const GivenStencil<T>& source, int64_t channels) {
  return {source.pattern->grid, channels, source.sample_stride == 0,
          [source](int64_t s) { return source.assemble(s); }};
}

}  // namespace prdp::kernels
