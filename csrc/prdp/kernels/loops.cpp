// Compiled once per instruction set, with PRDP_LEVEL naming it. Everything but the two tables has
// internal linkage, and nothing of the standard library is instantiated: no code for one processor can
// be linked in the place of another's.
#include "prdp/kernels/loops.h"
#include "prdp/kernels/periodic_loops.h"

namespace prdp::kernels {

namespace {

template <int Value>
struct Constant {
  static constexpr int value = Value;
};

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

/// One register of the instruction set. Sums over several vectors at once are written with it: their
/// plain loops, being nested, are not compiled into vector code.
#if defined(__AVX512F__)
constexpr int64_t kRegister = 64;
#elif defined(__AVX__)
constexpr int64_t kRegister = 32;
#else
constexpr int64_t kRegister = 16;
#endif
template <class T>
struct Register {
  typedef T Type __attribute__((vector_size(kRegister)));
};

/// v_j·w for the first `Count` vectors of v at once, in as many partial sums as hide the latency of an
/// addition.
template <int Count, class T>
void dot_block(const T* const* v, const T* w, T* h, int64_t n) {
  using Vector = typename Register<T>::Type;
  constexpr int64_t width = (Count > 4 ? 1 : Count > 2 ? 2 : 4) * kLanes<T>;
  constexpr int64_t lanes = kRegister / sizeof(T), registers = width / lanes;
  Vector sums[Count][registers] = {};
  int64_t i = 0;
  for (; i + width <= n; i += width) {
#pragma GCC unroll 16
    for (int64_t k = 0; k < registers; ++k) {
      Vector wk;
      __builtin_memcpy(&wk, w + i + k * lanes, sizeof wk);
#pragma GCC unroll 8
      for (int j = 0; j < Count; ++j) {
        Vector vk;
        __builtin_memcpy(&vk, v[j] + i + k * lanes, sizeof vk);
        sums[j][k] += vk * wk;
      }
    }
  }
  for (int j = 0; j < Count; ++j) {
    T part[width];
    __builtin_memcpy(part, sums[j], sizeof part);
    for (int64_t l = 0; i + l < n; ++l) part[l] += v[j][i + l] * w[i + l];
    h[j] = pairwise_sum(part);
  }
}

template <int Count, class T>
void axpy_block(const T* alpha, const T* const* v, T* w, int64_t n) {
  T a[Count];  // of their own, as w might overwrite those of the caller for all the compiler knows
  const T* from[Count];
  for (int j = 0; j < Count; ++j) a[j] = alpha[j], from[j] = v[j];
#pragma GCC ivdep
  for (int64_t i = 0; i < n; ++i) {
    T sum = w[i];
    for (int j = 0; j < Count; ++j) sum -= a[j] * from[j][i];
    w[i] = sum;
  }
}

/// Vectors that one pass over w takes.
constexpr int kBlock = 8;

/// Calls body for the blocks of `count` vectors: their first one, and their number as a constant.
template <int Count = kBlock, class Body>
void for_each_block(int64_t first, int64_t count, const Body& body) {
  for (; count - first >= Count; first += Count) body(first, Constant<Count>());
  if constexpr (Count > 1) for_each_block<Count - 1>(first, count, body);
}

template <class T>
void multi_dot(const T* const* v, int64_t count, const T* w, T* h, int64_t n) {
  for_each_block(0, count, [&](int64_t j, auto block) { dot_block<block.value>(v + j, w, h + j, n); });
}

template <class T>
void multi_axpy(const T* alpha, const T* const* v, int64_t count, T* w, int64_t n) {
  for_each_block(0, count, [&](int64_t j, auto block) { axpy_block<block.value>(alpha + j, v + j, w, n); });
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
          multi_dot<T>,
          multi_axpy<T>,
          {apply<1, T>, apply<2, T>, apply<3, T>},
          {sweep<1, T>, sweep<2, T>, sweep<3, T>},
          {sweep_and_measure<1, T>, sweep_and_measure<2, T>, sweep_and_measure<3, T>},
          upwind_row<T>,
          {apply_periodic<1, T>, apply_periodic<2, T>},
          apply_staggered<T>};
}

}  // namespace

#define PRDP_JOIN_(a, b) a##b
#define PRDP_JOIN(a, b) PRDP_JOIN_(a, b)
extern const Loops<float> PRDP_JOIN(float_loops_, PRDP_LEVEL);
extern const Loops<double> PRDP_JOIN(double_loops_, PRDP_LEVEL);
const Loops<float> PRDP_JOIN(float_loops_, PRDP_LEVEL) = table<float>(PRDP_LEVEL_NAME);
const Loops<double> PRDP_JOIN(double_loops_, PRDP_LEVEL) = table<double>(PRDP_LEVEL_NAME);

}  // namespace prdp::kernels
