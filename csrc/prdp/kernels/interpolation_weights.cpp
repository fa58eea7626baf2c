#include "prdp/kernels/interpolation_weights.h"

#include <algorithm>
#include <array>

namespace prdp::kernels {

namespace {

/// Sums of the coefficients with offset -1, 0 and 1 along an axis.
template <class T>
using SumsAlong = std::array<Field<T>, 3>;

/// add(place, row, to) adds the coefficients at a place of the stencil, for the points of a row, to memory.
template <class T, class Add>
SumsAlong<T> sums_along(const StencilFields<T>& a, int axis, const Add& add) {
  SumsAlong<T> sums;
  for (auto& s : sums) s.resize(a.points());
  for_each_row(a.grid, [&](const GridRow& row) {
    for (auto& s : sums) std::fill_n(s.data() + row.first, a.grid.shape[2], T(0));
    for (int k = 0; k < 27; ++k) add(k, row, sums[StencilFields<T>::offset(k).along[axis] + 1].data() + row.first);
  });
  return sums;
}

template <class T>
SumsAlong<T> sums_of_rows(const StencilFields<T>& a, int axis) {
  return sums_along(a, axis, [&](int k, const GridRow& row, T* to) {
    if (!a.coefficients[k]) return;
    const T* const own = a.coefficients[k] + row.first;
    for (int64_t i = 0; i < a.grid.shape[2]; ++i) to[i] += own[i];
  });
}

/// Of Aᵀ, which couples i to i + o as A couples i + o to i. Beyond the grid, A's own coefficient stands for it.
template <class T>
SumsAlong<T> sums_of_columns(const StencilFields<T>& a, int axis) {
  return sums_along(a, axis, [&](int k, const GridRow& row, T* to) {
    const T *own = a.coefficients[k], *opposite = a.coefficients[26 - k];
    if (!opposite) return;
    const T* const beyond = own ? own : opposite;
    const NeighboursOfRow neighbours(a.grid, row, StencilFields<T>::offset(k));
    for (int64_t i = 0; i < a.grid.shape[2]; ++i) {
      const int64_t there = neighbours.of(i);
      to[i] += there < 0 ? beyond[row.first + i] : opposite[there];
    }
  });
}

/// Fills the ring of a field: the other end of a periodic axis. Else it stays as it is.
template <class T>
void wrap_ring(const StencilGrid& grid, const RingedGrid& ringed, T* f) {
  const auto& [nz, ny, nx] = grid.shape;
  const auto row = [&](int64_t z, int64_t y) { return f + ringed.at(z, y, -1); };
  if (grid.periodic[2])
    for (int64_t z = 0; z < nz; ++z)
      for (int64_t y = 0; y < ny; ++y) {
        row(z, y)[0] = row(z, y)[nx];
        row(z, y)[nx + 1] = row(z, y)[1];
      }
  if (grid.periodic[1])
    for (int64_t z = 0; z < nz; ++z) {
      std::copy_n(row(z, ny - 1), nx + 2, row(z, -1));
      std::copy_n(row(z, 0), nx + 2, row(z, ny));
    }
  if (grid.periodic[0]) {
    const int64_t plane = ringed.ny * ringed.nx;
    std::copy_n(f + nz * plane, plane, f);
    std::copy_n(f + plane, plane, f + (nz + 1) * plane);
  }
}

/// The weights that the sums of each point give, with their ring: the other end of a periodic axis, else zeros.
template <class T>
Weights<T> weights_of(const StencilFields<T>& a, const SumsAlong<T>& sums,
                      const SumsAlong<T>* averaged_with = nullptr) {
  const StencilGrid& grid = a.grid;
  const T* diagonal = a.coefficients[StencilFields<T>::kCentre];
  const RingedGrid ringed(grid);
  Weights<T> w{zeros<T>(RingedGrid::size(grid)), zeros<T>(RingedGrid::size(grid))};
  for_each_row(grid, [&](const GridRow& row) {
    const int64_t to = ringed.at(row.z, row.y, 0);
    T *left = w.left.data() + to, *right = w.right.data() + to;
    for (int64_t i = 0; i < grid.shape[2]; ++i) {
      const int64_t at = row.first + i;
      T s[3] = {sums[0][at], sums[1][at], sums[2][at]};
      if (averaged_with)
        for (int d = 0; d < 3; ++d) s[d] += (*averaged_with)[d][at];
      const WeightsOfPoint<T> of_point(diagonal[at], s[0], s[1], s[2]);
      left[i] = of_point.left;
      right[i] = of_point.right;
    }
  });
  for (auto* field : {&w.left, &w.right}) wrap_ring(grid, ringed, field->data());
  return w;
}

}  // namespace

template <class T>
AxisTransfer<T> make_transfer(const StencilFields<T>& a, int axis, bool symmetric) {
  const auto of_rows = sums_of_rows(a, axis);
  if (symmetric) {
    auto w = weights_of(a, of_rows);
    return {w, w};
  }
  const auto of_columns = sums_of_columns(a, axis);
  return {weights_of(a, of_rows, &of_columns), weights_of(a, of_columns)};
}

template AxisTransfer<float> make_transfer(const StencilFields<float>&, int, bool);
template AxisTransfer<double> make_transfer(const StencilFields<double>&, int, bool);

}  // namespace prdp::kernels
