// Compiled once per instruction set, with PRDP_LEVEL naming it. Everything but the two tables has
// internal linkage, and nothing of the standard library is instantiated: no code for one processor can
// be linked in the place of another's.
#include "prdp/kernels/loops.h"

namespace prdp::kernels {

namespace {

/// Sum of partial sums, pairwise: the order depends on nothing but their number.
template <class T, int64_t Width>
T pairwise_sum(T (&part)[Width]) {
  for (int64_t half = Width / 2; half > 0; half /= 2)
    for (int64_t l = 0; l < half; ++l) part[l] += part[l + half];
  return part[0];
}

template <class T>
T dot(const T* a, const T* b, int64_t n) {
  constexpr int64_t width = 4 * kLanes<T>;
  T part[width] = {};
  int64_t i = 0;
  for (; i + width <= n; i += width)
    for (int64_t l = 0; l < width; ++l) part[l] += a[i + l] * b[i + l];
  for (int64_t l = 0; i + l < n; ++l) part[l] += a[i + l] * b[i + l];
  return pairwise_sum(part);
}

template <class T>
void axpy(T alpha, const T* __restrict x, T* __restrict y, int64_t n) {
  for (int64_t i = 0; i < n; ++i) y[i] += alpha * x[i];
}

template <class T>
void xpby(const T* __restrict x, T beta, T* __restrict y, int64_t n) {
  for (int64_t i = 0; i < n; ++i) y[i] = x[i] + beta * y[i];
}

template <class T>
T descend(T alpha, const T* p, const T* q, T* x, T* r, int64_t n) {
  constexpr int64_t width = kLanes<T>;
  T part[width] = {};
  for (int64_t i = 0; i < n; i += width) {
#pragma GCC ivdep
    for (int64_t l = 0; l < width; ++l) {
      x[i + l] += alpha * p[i + l];
      r[i + l] -= alpha * q[i + l];
      part[l] += r[i + l] * r[i + l];
    }
  }
  return pairwise_sum(part);
}

/// Weighted sum of the 2·Dim neighbours of v[l]; w points at the x weights of the same lane.
template <int Dim, class T>
T neighbours(const T* w, const T* v, int64_t l, int64_t row, int64_t plane) {
  T sum = w[l] * (v[l - 1] + v[l + 1]);
  if constexpr (Dim > 1) sum += w[row + l] * (v[l - row] + v[l + row]);
  if constexpr (Dim > 2) sum += w[2 * row + l] * (v[l - plane] + v[l + plane]);
  return sum;
}

template <int Dim, class T>
void apply_row(const T* __restrict w, const T* __restrict v, T* __restrict out, int64_t row, int64_t plane) {
  for (int64_t i = 0; i < row; i += kLanes<T>) {
#pragma GCC ivdep
    for (int64_t l = 0; l < kLanes<T>; ++l)
      out[i + l] = w[i + l] * v[i + l] + neighbours<Dim>(w + row, v, i + l, row, plane);
  }
}

template <int Dim, class T>
void apply(const PaddedStencil<T>& a, const T* v, T* out) {
  for (int64_t z = 0; z < a.nz; ++z)
    for (int64_t y = 0; y < a.ny; ++y) {
      const int64_t at = z * a.plane + y * a.row;
      apply_row<Dim>(a.weights, v + at, out + at, a.row, a.plane);
    }
}

template <int Dim, bool Measure, class T>
void sweep_row(const T* __restrict w, const T* __restrict c, const T* __restrict x, T* __restrict y,
               int64_t row, int64_t plane, T* __restrict part) {
  for (int64_t i = 0; i < row; i += kLanes<T>) {
#pragma GCC ivdep
    for (int64_t l = 0; l < kLanes<T>; ++l) {
      const T next = c[i + l] + neighbours<Dim>(w, x, i + l, row, plane);
      if constexpr (Measure) {
        const T change = next - x[i + l];
        part[l] += change * change;
      }
      y[i + l] = next;
    }
  }
}

template <int Dim, bool Measure, class T>
T sweep_all(const PaddedStencil<T>& a, const T* c, const T* x, T* y) {
  T part[kLanes<T>] = {};
  for (int64_t z = 0; z < a.nz; ++z)
    for (int64_t j = 0; j < a.ny; ++j) {
      const int64_t at = z * a.plane + j * a.row;
      sweep_row<Dim, Measure>(a.weights, c + at, x + at, y + at, a.row, a.plane, part);
    }
  return pairwise_sum(part);
}

template <int Dim, class T>
void sweep(const PaddedStencil<T>& a, const T* c, const T* x, T* y) {
  sweep_all<Dim, false>(a, c, x, y);
}
template <int Dim, class T>
T sweep_and_measure(const PaddedStencil<T>& a, const T* c, const T* x, T* y) {
  return sweep_all<Dim, true>(a, c, x, y);
}

template <class T>
constexpr Loops<T> table(const char* level) {
  return {level,
          dot<T>,
          axpy<T>,
          xpby<T>,
          descend<T>,
          {apply<1, T>, apply<2, T>, apply<3, T>},
          {sweep<1, T>, sweep<2, T>, sweep<3, T>},
          {sweep_and_measure<1, T>, sweep_and_measure<2, T>, sweep_and_measure<3, T>}};
}

}  // namespace

#define PRDP_JOIN_(a, b) a##b
#define PRDP_JOIN(a, b) PRDP_JOIN_(a, b)
extern const Loops<float> PRDP_JOIN(float_loops_, PRDP_LEVEL);
extern const Loops<double> PRDP_JOIN(double_loops_, PRDP_LEVEL);
const Loops<float> PRDP_JOIN(float_loops_, PRDP_LEVEL) = table<float>(PRDP_LEVEL_NAME);
const Loops<double> PRDP_JOIN(double_loops_, PRDP_LEVEL) = table<double>(PRDP_LEVEL_NAME);

}  // namespace prdp::kernels
