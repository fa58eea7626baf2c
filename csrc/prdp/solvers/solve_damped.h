#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "prdp/solvers/space.h"

namespace prdp {

/// Numbers that solve_damped() works with.
constexpr int64_t numbers_of_solve_damped(int64_t n) { return n * (n + 2); }

/// √(a² + b²), with the same bits on every device, which std::hypot() does not promise.
template <class T>
T hypotenuse(T a, T b) {
  const T larger = std::max(std::abs(a), std::abs(b)), smaller = std::min(std::abs(a), std::abs(b));
  if (larger == T(0)) return T(0);
  const T ratio = smaller / larger;
  return larger * std::sqrt(1 + ratio * ratio);
}

/// y = argmin ‖g - R y‖² + τ² ‖y‖² for the upper triangle R in the first n columns of a Hessenberg matrix r: the rows
/// of τ I are rotated into R, one by one.
template <class T>
void solve_damped(const T* r, const T* g, int64_t n, T tau, T* y, T* work) {
  T *a = work, *rhs = a + n * n, *row = rhs + n;
  PRDP_NO_UNROLL for (int64_t j = 0; j < n; ++j) {
    rhs[j] = g[j];
    PRDP_NO_UNROLL for (int64_t i = 0; i <= j; ++i) a[i * n + j] = r[hessenberg_column(j) + i];
  }
  PRDP_NO_UNROLL for (int64_t k = 0; k < n; ++k) {
    PRDP_NO_UNROLL for (int64_t j = 0; j < n; ++j) row[j] = 0;
    row[k] = tau;
    T of_row = 0;
    PRDP_NO_UNROLL for (int64_t i = k; i < n; ++i) {
      const T length = hypotenuse(a[i * n + i], row[i]);
      if (length == T(0)) continue;
      const T cos = a[i * n + i] / length, sin = row[i] / length;
      const auto rotate = [&](T& upper, T& lower) {
        const T rotated = cos * upper + sin * lower;
        lower = cos * lower - sin * upper;
        upper = rotated;
      };
      PRDP_NO_UNROLL for (int64_t j = i; j < n; ++j) rotate(a[i * n + j], row[j]);
      rotate(rhs[i], of_row);
    }
  }
  PRDP_NO_UNROLL for (int64_t i = n - 1; i >= 0; --i) {
    T sum = rhs[i];
    PRDP_NO_UNROLL for (int64_t j = i + 1; j < n; ++j) sum -= a[i * n + j] * y[j];
    y[i] = a[i * n + i] == T(0) ? T(0) : sum / a[i * n + i];
  }
}

}  // namespace prdp
