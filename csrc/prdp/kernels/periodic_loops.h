#pragma once
#include "prdp/kernels/registers.h"

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

/// Goes along a row register by register, with the ones before and after for the neighbours. What these
/// hold beyond the ends of the row meets weights of zero.
template <class T>
struct Line {
  const T* v;
  Register<T> before = {}, here = {}, after;

  explicit Line(const T* row) : v(row), after(load(row)) {}
  void step_to(int64_t i) {
    before = here;
    here = after;
    after = load(v + i + kWidth<T>);
  }
  Register<T> left() const { return lanes_from<T, kWidth<T> - 1>(before, here); }
  Register<T> right() const { return lanes_from<T, 1>(here, after); }
};

/// Row j of a field and what lies below and above it; its coefficients in A.
template <int Dim, class T>
struct PeriodicRow {
  const PeriodicStencil<T>& a;
  int64_t row;
  const T *w, *wraps, *below, *above;
  Line<T> line;

  PeriodicRow(const PeriodicStencil<T>& stencil, int64_t j, const T* field)
      : a(stencil), row(stencil.row), w(stencil.coefficients + j * (2 * Dim + 1) * row),
        wraps(stencil.wraps + 2 * j), below(field + row_below(stencil, j)),
        above(field + row_above(stencil, j)), line(field + j * row) {}

  /// A v at register i, but for the wraps, which are added to the whole row at its end.
  Register<T> product(int64_t i) {
    line.step_to(i);
    Register<T> sum = load(w + i) * line.here;
    sum += load(w + row + i) * line.left();
    sum += load(w + 2 * row + i) * line.right();
    if constexpr (Dim > 1) {
      sum += load(w + 3 * row + i) * load(below + i);
      sum += load(w + 4 * row + i) * load(above + i);
    }
    return sum;
  }
  void add_wraps(T* out) const {
    out[0] += wraps[0] * line.v[a.nx - 1];
    out[a.nx - 1] += wraps[1] * line.v[0];
  }
};

template <int Dim, class T>
void apply_periodic(const PeriodicStencil<T>& a, const T* v, T* out) {
  for (int64_t j = 0; j < a.ny; ++j, out += a.row) {
    PeriodicRow<Dim, T> u(a, j, v);
    for (int64_t i = 0; i < u.row; i += kWidth<T>) store(out + i, u.product(i));
    u.add_wraps(out);
  }
}

template <class T>
void apply_staggered(const StaggeredStencil<T>& a, const T* v, T* out) {
  const auto& grid = a.velocity[0];
  const int64_t row = grid.row, field = grid.ny * row, last = grid.nx - 1;
  const T *x = a.weights, *x_lower = x + row, *x_upper = x + 2 * row, *y = x + 3 * row;
  T *out1 = out, *out2 = out + field, *divergence = out + 2 * field;
  for (int64_t j = 0; j < grid.ny; ++j, out1 += row, out2 += row, divergence += row) {
    PeriodicRow<2, T> u1(a.velocity[0], j, v), u2(a.velocity[1], j, v + field);
    Line<T> p(v + 2 * field + j * row);
    const T* p_below = v + 2 * field + row_below(grid, j);
    for (int64_t i = 0; i < row; i += kWidth<T>) {
      p.step_to(i);
      store<T>(out1 + i, u1.product(i) + load(x + i) * p.here - load(x_lower + i) * p.left());
      store<T>(out2 + i, u2.product(i) + load(y + i) * (p.here - load(p_below + i)));
      store<T>(divergence + i, load(x_upper + i) * u1.line.right() - load(x + i) * u1.line.here +
                                   load(y + i) * (load(u2.above + i) - u2.line.here));
    }
    u1.add_wraps(out1);
    u2.add_wraps(out2);
    out1[0] -= x[0] * p.v[last];
    divergence[last] += x[0] * u1.line.v[0];
  }
}

}  // namespace

}  // namespace prdp::kernels
