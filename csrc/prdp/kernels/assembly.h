#pragma once
#include <algorithm>
#include <array>
#include <memory>
#include <vector>

#include "prdp/kernels/packed_stencil.h"
#include "prdp/kernels/stencil_fields.h"

/// Coefficients from fields to the rows that the loops take, and back.
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

/// The rows of factor times the stencil with these coefficients, each (nz, ny, nx) and one for each offset that
/// `pattern` was given; or of its transpose: the stencil of the opposite offsets, of which `pattern` is then to be.
template <class T>
PackedStencil<T> assemble_rows(std::shared_ptr<const StencilSparsity> pattern,
                               const std::vector<const T*>& coefficients, T factor, bool transposed) {
  PackedStencil<T> a(pattern);
  const auto& [nz, ny, nx] = pattern->grid.shape;
  const auto& loops = kernels::loops<T>();
  std::vector<bool> holds(pattern->offsets.size());
  for (size_t given = 0; given < coefficients.size(); ++given) {
    const int64_t k = pattern->places[given];
    if (k < 0) continue;
    const auto along = [&](int axis) {
      return runs(pattern->offsets[k].along[axis], pattern->grid.shape[axis], pattern->grid.periodic[axis], transposed);
    };
    for (const Run& z : along(0))
      for (int64_t plane = 0; plane < z.count; ++plane)
        for (const Run& y : along(1))
          for (const Run& x : along(2)) {
            if (y.count == 0 || x.count == 0) continue;
            T* to = a.coefficient((z.to + plane) * ny + y.to, k) + x.to;
            const T* source = coefficients[given] + ((z.from + plane) * ny + y.from) * nx + x.from;
            for_each_run_of_rows(y.count, x.count, [&](int64_t begin, int64_t end) {
              if (!holds[k]) {
                loops.copy_rows(factor, source + begin * nx, nx, to + begin * a.stride(), a.stride(), end - begin,
                                x.count);
                return;
              }
              for (int64_t r = begin; r < end; ++r)
                for (int64_t i = 0; i < x.count; ++i) to[r * a.stride() + i] += factor * source[r * nx + i];
            });
          }
    holds[k] = true;
  }
  a.close();
  return a;
}

/// The coefficients of a stencil of nearest neighbours on a periodic grid as contiguous fields.
template <class T>
StencilFields<T> fields_of(const PackedStencil<T>& rows) {
  StencilFields<T> a(rows.grid());
  std::vector<T*> fields;
  for (const auto& o : rows.pattern().offsets) fields.push_back(a.add(StencilFields<T>::place(o)));
  const auto& [nz, ny, nx] = rows.grid().shape;
  rows.for_each_coefficient([&](int64_t row, int64_t k, int64_t i, T value) { fields[k][row * nx + i] = value; });
  return a;
}

}  // namespace prdp::kernels
