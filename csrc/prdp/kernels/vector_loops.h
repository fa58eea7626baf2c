#pragma once
#include "prdp/kernels/registers.h"

/// The part of loops.cpp for sums over whole vectors; included there only.
namespace prdp::kernels {

namespace {

template <int Value>
struct Constant {
  static constexpr int value = Value;
};

/// Calls body(first, size) for blocks of `count` things, sizes being constants of at most Size.
template <int Size, class Body>
void for_each_block(int64_t first, int64_t count, const Body& body) {
  for (; count - first >= Size; first += Size) body(first, Constant<Size>());
  if constexpr (Size > 1) for_each_block<Size - 1>(first, count, body);
}

/// Vectors that one pass takes at once.
constexpr int kVectorsAtOnce = kRegisterBytes == 64 ? 8 : 4;

/// h_j = v_j·(factor·w) for the first Count vectors of v, in as many partial sums as hide the latency of an addition.
template <int Count, class T>
void dot_block(const T* const* v, T factor, const T* w, T* h, int64_t n) {
  constexpr int chains = Count > 2 ? 1 : 4 / Count;
  Register<T> sums[Count][chains] = {};
  int64_t i = 0;
  for (; i + chains * kWidth<T> <= n; i += chains * kWidth<T>)
    for (int k = 0; k < chains; ++k) {
      const auto wk = factor * load(w + i + k * kWidth<T>);
      for (int j = 0; j < Count; ++j) sums[j][k] += wk * load(v[j] + i + k * kWidth<T>);
    }
  for (; i < n; i += kWidth<T>)
    for (int j = 0; j < Count; ++j) sums[j][0] += factor * load(w + i) * load(v[j] + i);
  for (int j = 0; j < Count; ++j) {
    for (int k = 1; k < chains; ++k) sums[j][0] += sums[j][k];
    h[j] = sum_lanes<T>(sums[j][0]);
  }
}

template <class T>
void multi_dot(const T* const* v, int64_t count, T factor, const T* w, T* h, int64_t n) {
  for_each_block<kVectorsAtOnce>(0, count,
                                 [&](int64_t j, auto size) { dot_block<size.value>(v + j, factor, w, h + j, n); });
}

template <class T>
T dot(const T* a, const T* b, int64_t n) {
  const int64_t whole = n / kWidth<T> * kWidth<T>;
  T sum;
  dot_block<1>(&a, T(1), b, &sum, whole);
  for (int64_t i = whole; i < n; ++i) sum += a[i] * b[i];
  return sum;
}

/// Calls body(i, k) for each register i of n values, k being 0 and 1 in turn: for two sums at once, as an addition
/// waits for the one before it.
template <class T, class Body>
void for_each_in_turn(int64_t n, const Body& body) {
  int64_t i = 0;
  for (; i + 2 * kWidth<T> <= n; i += 2 * kWidth<T>) {
    body(i, 0);
    body(i + kWidth<T>, 1);
  }
  if (i < n) body(i, 0);
}

/// w = factor·w + sign·Σ alpha_j v_j over the first Count vectors of v; returns ‖w‖².
template <int Count, class T>
T axpy_block(T sign, const T* alpha, const T* const* v, T factor, T* w, int64_t n) {
  T a[Count];  // of their own, as w might overwrite those of the caller for all the compiler knows
  const T* from[Count];
  for (int j = 0; j < Count; ++j) a[j] = sign * alpha[j], from[j] = v[j];
  Register<T> squares[2] = {};
  const auto add = [&](int64_t i, int k) {
    auto wi = factor * load(w + i);
    for (int j = 0; j < Count; ++j) wi += a[j] * load(from[j] + i);
    store(w + i, wi);
    squares[k] += wi * wi;
  };
  for_each_in_turn<T>(n, add);
  return sum_lanes<T>(squares[0] + squares[1]);
}

template <class T>
T multi_axpy(T sign, const T* alpha, const T* const* v, int64_t count, T factor, T* w, int64_t n) {
  T norm2 = 0;
  for_each_block<kVectorsAtOnce>(0, count, [&](int64_t j, auto size) {
    norm2 = axpy_block<size.value>(sign, alpha + j, v + j, j == 0 ? factor : T(1), w, n);
  });
  return norm2;
}

template <class T>
void axpy(T alpha, const T* __restrict x, T* __restrict y, int64_t n) {
  for (int64_t i = 0; i < n; ++i) y[i] += alpha * x[i];
}

template <class T>
void add_product(const T* __restrict c, const T* __restrict v, T* __restrict out, int64_t n) {
  for (int64_t i = 0; i < n; ++i) out[i] += c[i] * v[i];
}

template <class T>
void xpby(const T* x, T beta, T* y, int64_t n) {
  for (int64_t i = 0; i < n; i += kWidth<T>) store<T>(y + i, load(x + i) + beta * load(y + i));
}

template <class T>
void scale(T factor, const T* x, T* out, int64_t n) {
  for (int64_t i = 0; i < n; i += kWidth<T>) store<T>(out + i, factor * load(x + i));
}

template <class T>
void scale_with_dots(T factor, const T* x, const T* w, T* out, T* dots, int64_t n) {
  Register<T> along[2] = {}, squares[2] = {};
  for_each_in_turn<T>(n, [&](int64_t i, int k) {
    const Register<T> scaled = factor * load(x + i);
    store(out + i, scaled);
    along[k] += scaled * load(w + i);
    squares[k] += scaled * scaled;
  });
  dots[0] = sum_lanes<T>(along[0] + along[1]);
  dots[1] = sum_lanes<T>(squares[0] + squares[1]);
}

template <class T>
T xpby_with_square(const T* x, T beta, T* y, int64_t n) {
  Register<T> squares[2] = {};
  for_each_in_turn<T>(n, [&](int64_t i, int k) {
    const Register<T> yi = load(x + i) + beta * load(y + i);
    store(y + i, yi);
    squares[k] += yi * yi;
  });
  return sum_lanes<T>(squares[0] + squares[1]);
}

template <class T>
T update_iterate_and_residual(T alpha, const T* p, const T* q, T* x, T* r, int64_t n) {
  Register<T> squares[2] = {};
  for_each_in_turn<T>(n, [&](int64_t i, int k) {
    store(x + i, load(x + i) + alpha * load(p + i));
    const Register<T> ri = load(r + i) - alpha * load(q + i);
    store(r + i, ri);
    squares[k] += ri * ri;
  });
  return sum_lanes<T>(squares[0] + squares[1]);
}

template <class T>
T weigh(const T* w, const T* x, T* out, int64_t n) {
  Register<T> sums[2] = {};
  for_each_in_turn<T>(n, [&](int64_t i, int k) {
    const Register<T> xi = load(x + i), product = load(w + i) * xi;
    store(out + i, product);
    sums[k] += xi * product;
  });
  return sum_lanes<T>(sums[0] + sums[1]);
}

/// Rows of at least a register end with one that reaches back over the one before.
template <class T>
void copy_rows(T factor, const T* from, int64_t from_stride, T* to, int64_t to_stride, int64_t rows, int64_t n) {
  for (; rows > 0; --rows, from += from_stride, to += to_stride) {
    if (n < kWidth<T>) {
      for (int64_t i = 0; i < n; ++i) to[i] = factor * from[i];
      continue;
    }
    for (int64_t i = 0; i + kWidth<T> < n; i += kWidth<T>) store<T>(to + i, factor * load(from + i));
    store<T>(to + n - kWidth<T>, factor * load(from + n - kWidth<T>));
  }
}

/// Compares the bits without their sign, which order like the numbers and have NaN and Inf on top, so
/// that nothing slips through a comparison with NaN.
template <class T>
T largest_magnitude(const T* x, int64_t n) {
  using Bits = std::conditional_t<sizeof(T) == 4, int32_t, int64_t>;
  Bits largest = 0;
  for (int64_t i = 0; i < n; ++i) {
    Bits bits;
    __builtin_memcpy(&bits, x + i, sizeof bits);
    bits &= ~(Bits(1) << (8 * sizeof(T) - 1));
    largest = bits > largest ? bits : largest;
  }
  T value;
  __builtin_memcpy(&value, &largest, sizeof value);
  return value;
}

}  // namespace

}  // namespace prdp::kernels
