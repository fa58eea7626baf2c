#pragma once
#include <array>

#include "prdp/kernels/whole_vectors.h"

namespace prdp {

/// The loops of WholeVectors for vectors of any length: by whole registers, then what is left one by one.
template <class T>
class AnyLength {
 public:
  T dot(const T* a, const T* b, int64_t n) const { return loops_.dot(a, b, n); }
  T largest_magnitude(const T* x, int64_t n) const { return loops_.largest_magnitude(x, n); }
  void scale(T factor, const T* x, T* out, int64_t n) const {
    const int64_t m = whole(n);
    loops_.scale(factor, x, out, m);
    for (int64_t i = m; i < n; ++i) out[i] = factor * x[i];
  }
  std::array<T, 2> scale_with_dots(T factor, const T* x, const T* w, T* out, int64_t n) const {
    const int64_t m = whole(n);
    auto dots = loops_.scale_with_dots(factor, x, w, out, m);
    for (int64_t i = m; i < n; ++i) {
      out[i] = factor * x[i];
      dots[0] += out[i] * w[i];
      dots[1] += out[i] * out[i];
    }
    return dots;
  }
  void xpby(const T* x, T beta, T* y, int64_t n) const {
    const int64_t m = whole(n);
    loops_.xpby(x, beta, y, m);
    for (int64_t i = m; i < n; ++i) y[i] = x[i] + beta * y[i];
  }
  T update_iterate_and_residual(T alpha, const T* p, const T* q, T* x, T* r, int64_t n) const {
    const int64_t m = whole(n);
    T square = loops_.update_iterate_and_residual(alpha, p, q, x, r, m);
    for (int64_t i = m; i < n; ++i) {
      x[i] += alpha * p[i];
      r[i] -= alpha * q[i];
      square += r[i] * r[i];
    }
    return square;
  }
  void multi_dot(const T* const* v, int64_t count, T factor, const T* w, T* h, int64_t n) const {
    const int64_t m = whole(n);
    loops_.multi_dot(v, count, factor, w, h, m);
    for (int64_t j = 0; j < count; ++j)
      for (int64_t i = m; i < n; ++i) h[j] += v[j][i] * (factor * w[i]);
  }
  T multi_axpy(T sign, const T* alpha, const T* const* v, int64_t count, T factor, T* w, int64_t n) const {
    const int64_t m = whole(n);
    T square = loops_.multi_axpy(sign, alpha, v, count, factor, w, m);
    for (int64_t i = m; i < n; ++i) {
      T sum = factor * w[i];
      for (int64_t j = 0; j < count; ++j) sum += sign * alpha[j] * v[j][i];
      w[i] = sum;
      square += sum * sum;
    }
    return square;
  }

 private:
  static int64_t whole(int64_t n) { return n - n % kernels::kLanes<T>; }

  kernels::WholeVectors<T> loops_;
};

}  // namespace prdp
