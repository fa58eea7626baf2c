#pragma once
#include "prdp/kernels/assembly.h"

namespace prdp::kernels {

/// out[i] += λ[i] · v[i + offset] for all points i that have a neighbour there; fields are (nz, ny, nx), and
/// `offset` is one of a StencilSparsity's.
template <class T>
void add_products(const StencilGrid& grid, const Offset& offset, const T* lambda, const T* v, T* out) {
  const auto& [nz, ny, nx] = grid.shape;
  const auto along = [&](int axis) {
    return runs(offset.along[axis], grid.shape[axis], grid.periodic[axis], /*transposed=*/true);
  };
  for (const Run& z : along(0))
    for (int64_t plane = 0; plane < z.count; ++plane)
      for (const Run& y : along(1))
        for (int64_t row = 0; row < y.count; ++row)
          for (const Run& x : along(2)) {
            const int64_t to = ((z.to + plane) * ny + y.to + row) * nx + x.to;
            const T* l = lambda + to;
            const T* there = v + ((z.from + plane) * ny + y.from + row) * nx + x.from;
            T* __restrict sum = out + to;
            for (int64_t i = 0; i < x.count; ++i) sum[i] += l[i] * there[i];
          }
}

}  // namespace prdp::kernels
