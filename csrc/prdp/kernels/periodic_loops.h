#pragma once
#include "prdp/kernels/loops.h"

/// The part of loops.cpp for operators on periodic grids; included there only, and for the same reason
/// all of internal linkage.
namespace prdp::kernels {

namespace {

template <class T>
void upwind_row(T advection, T diffusion, const T* before, const T* here, const T* after,
                T* __restrict lower, T* __restrict upper, T* __restrict centre, int64_t n) {
  const T half = advection / 2;
  for (int64_t i = 0; i < n; ++i) {
    const T sum_before = before[i] + here[i], sum_after = here[i] + after[i];
    const T backward = half * (sum_before > T(0) ? sum_before : T(0));
    const T forward = half * (sum_after < T(0) ? sum_after : T(0));
    lower[i] = -backward - diffusion;
    upper[i] = forward - diffusion;
    centre[i] += backward - forward + 2 * diffusion;
  }
}

/// The neighbours of row j along y, round the ends.
template <class T>
int64_t row_below(const PeriodicStencil<T>& a, int64_t j) {
  return (j > 0 ? j - 1 : a.ny - 1) * a.row;
}
template <class T>
int64_t row_above(const PeriodicStencil<T>& a, int64_t j) {
  return (j + 1 < a.ny ? j + 1 : 0) * a.row;
}

template <int Dim, class T>
void periodic_row(const PeriodicStencil<T>& a, int64_t j, const T* field, T* result) {
  const int64_t row = a.row;
  const T *w = a.coefficients + j * (2 * Dim + 1) * row, *wraps = a.wraps + 2 * j;
  const T *v = field + j * row, *below = field + row_below(a, j), *above = field + row_above(a, j);
  T* __restrict out = result + j * row;
  for (int64_t i = 0; i < row; i += kLanes<T>) {
#pragma GCC ivdep
    for (int64_t l = i; l < i + kLanes<T>; ++l) {
      T sum = w[l] * v[l] + w[row + l] * v[l - 1] + w[2 * row + l] * v[l + 1];
      if constexpr (Dim > 1) sum += w[3 * row + l] * below[l] + w[4 * row + l] * above[l];
      out[l] = sum;
    }
  }
  out[0] += wraps[0] * v[a.nx - 1];
  out[a.nx - 1] += wraps[1] * v[0];
}

template <int Dim, class T>
void apply_periodic(const PeriodicStencil<T>& a, const T* v, T* out) {
  for (int64_t j = 0; j < a.ny; ++j) periodic_row<Dim>(a, j, v, out);
}

/// Adds the pressure gradient to row j of both velocities, and sets the divergence in it.
template <class T>
void couple_row(const StaggeredStencil<T>& a, int64_t j, const T* v, T* result) {
  const auto& grid = a.velocity[0];
  const int64_t row = grid.row, nx = grid.nx, field = grid.ny * row, at = j * row;
  const T *u1 = v + at, *u2 = u1 + field, *u2_above = v + field + row_above(grid, j);
  const T *p = u2 + field, *p_below = v + 2 * field + row_below(grid, j);
  const T *x = a.weights, *x_lower = x + row, *x_upper = x + 2 * row, *y = x + 3 * row;
  T *__restrict g1 = result + at, *__restrict g2 = g1 + field, *__restrict d = g2 + field;
  for (int64_t i = 0; i < row; i += kLanes<T>) {
#pragma GCC ivdep
    for (int64_t l = i; l < i + kLanes<T>; ++l) {
      g1[l] += x[l] * p[l] - x_lower[l] * p[l - 1];
      g2[l] += y[l] * (p[l] - p_below[l]);
      d[l] = x_upper[l] * u1[l + 1] - x[l] * u1[l] + y[l] * (u2_above[l] - u2[l]);
    }
  }
  g1[0] -= x[0] * p[nx - 1];
  d[nx - 1] += x[0] * u1[0];
}

template <class T>
void apply_staggered(const StaggeredStencil<T>& a, const T* v, T* out) {
  const auto& grid = a.velocity[0];
  const int64_t field = grid.ny * grid.row;
  for (int64_t j = 0; j < grid.ny; ++j) {
    periodic_row<2>(a.velocity[0], j, v, out);
    periodic_row<2>(a.velocity[1], j, v + field, out + field);
    couple_row(a, j, v, out);
  }
}

}  // namespace

}  // namespace prdp::kernels
