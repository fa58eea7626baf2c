#pragma once
#include <cmath>
#include <cstdint>

#include "prdp/gpu/device/coarse_grid.h"

/// The inverse of a small matrix, and of a singular one the pseudo-inverse, by the threads of one block: a complete
/// orthogonal decomposition A P = Q [T 0; 0 0] Zᵀ by Householder's reflections (Golub and Van Loan 2013, section 5.5).
namespace prdp::gpu {

/// How many parts of at least two points there are that nothing couples to each other, of n ≤ kMostOfCoarsest points.
template <int threads>
PRDP_ONCE int count_parts(int n, const double* a, int* labels) {
  const int t = static_cast<int>(threadIdx.x);
  const auto coupled = [&](int i, int j) { return a[i * n + j] != 0.0 || a[j * n + i] != 0.0; };
  for (int i = t; i < n; i += threads) labels[i] = i;
  for (int pass = 0; pass < n; ++pass) {  // the least number of a part spreads
    const int* const from = labels + pass % 2 * n;
    int* const to = labels + (1 - pass % 2) * n;
    __syncthreads();
    for (int i = t; i < n; i += threads) {
      int least = from[i];
      for (int j = 0; j < n; ++j)
        if (coupled(i, j) && from[j] < least) least = from[j];
      to[i] = least;
    }
  }
  __syncthreads();
  const int* const found = labels + n % 2 * n;
  int parts = 0;
  for (int i = 0; i < n; ++i) {
    bool is_first = false;
    for (int j = i + 1; j < n && found[i] == i; ++j) is_first = is_first || found[j] == i;
    parts += is_first;
  }
  return parts;
}

/// `work` begins with A (n, n), which is overwritten; the inverse goes to `out`, (n, n) too. What is below `tiny`
/// beside the largest is left out. Of a null space of `nullity` dimensions, rounding of the coefficients may have made
/// the matrix regular, and its inverse would be rounding all the same: so many are left out, unless the null vectors of
/// pockets are gone on so coarse a grid.
template <int threads, class T>
PRDP_ONCE void pseudo_inverse(int n, double* work, int nullity, double tiny, T* out) {
  const int t = static_cast<int>(threadIdx.x);
  double *const a = work, *const x = a + n * n, *const scale = x + n * n, *const norm2 = scale + n;
  double *const head = norm2 + n, *const beta = head + n, *const z_head = beta + n, *const z_beta = z_head + n;
  int *const order = reinterpret_cast<int*>(z_beta + n), *const labels = order + n;
  const bool all_are_there = nullity == 0 || count_parts<threads>(n, a, labels) >= nullity;
  // What is tiny may only be so beside a larger diagonal: it is brought to the order of one.
  for (int i = t; i < n; i += threads) {
    const double d = std::abs(a[i * n + i]);
    scale[i] = d == 0.0 ? 1.0 : std::ldexp(1.0, -std::ilogb(d) / 2);
    order[i] = i;
  }
  __syncthreads();
  for (int j = t; j < n; j += threads) {
    double sum = 0;
    for (int i = 0; i < n; ++i) {
      const double v = a[i * n + j] *= scale[i] * scale[j];
      sum += v * v;
    }
    norm2[j] = sum;
  }
  __syncthreads();

  // A P = Q R: each thread has columns of its own.
  int rank = 0;
  double first = 0;
  for (; rank < n; ++rank) {
    int pivot = rank;
    for (int j = rank + 1; j < n; ++j)
      if (norm2[j] > norm2[pivot]) pivot = j;
    const double size = std::sqrt(norm2[pivot]);
    if (rank == 0) first = size;
    const bool is_null = rank >= n - nullity && (all_are_there || size < 1e-3 * first);
    if (is_null || !(size > tiny * first)) break;
    __syncthreads();
    for (int i = t; i < n; i += threads) std::swap(a[i * n + rank], a[i * n + pivot]);
    if (t == 0) std::swap(order[rank], order[pivot]);
    __syncthreads();
    const double alpha = a[rank * n + rank], v = alpha + (alpha < 0 ? -size : size);
    const double by = 1.0 / (size * (size + std::abs(alpha)));
    for (int j = rank + 1 + t; j < n; j += threads) {
      double along = v * a[rank * n + j];
      for (int i = rank + 1; i < n; ++i) along += a[i * n + rank] * a[i * n + j];
      along *= by;
      a[rank * n + j] -= along * v;
      double left = 0;
      for (int i = rank + 1; i < n; ++i) {
        const double w = a[i * n + j] -= along * a[i * n + rank];
        left += w * w;
      }
      norm2[j] = left;
    }
    __syncthreads();
    if (t == 0) {
      a[rank * n + rank] = alpha < 0 ? size : -size;
      head[rank] = v;
      beta[rank] = by;
    }
  }
  // What R has beside its first columns goes into them: each thread has rows of its own.
  for (int k = rank < n ? rank - 1 : -1; k >= 0; --k) {
    __syncthreads();
    double beyond = 0;
    for (int c = rank; c < n; ++c) beyond += a[k * n + c] * a[k * n + c];
    const double alpha = a[k * n + k], size = std::sqrt(alpha * alpha + beyond);
    const double v = alpha + (alpha < 0 ? -size : size), by = 1.0 / (size * (size + std::abs(alpha)));
    for (int i = t; i < k; i += threads) {
      double along = v * a[i * n + k];
      for (int c = rank; c < n; ++c) along += a[k * n + c] * a[i * n + c];
      along *= by;
      a[i * n + k] -= along * v;
      for (int c = rank; c < n; ++c) a[i * n + c] -= along * a[k * n + c];
    }
    __syncthreads();
    if (t == 0) {
      a[k * n + k] = alpha < 0 ? size : -size;
      z_head[k] = v;
      z_beta[k] = by;
    }
  }
  __syncthreads();
  // P Z T⁻¹ Qᵀ: each thread has columns of its own.
  for (int j = t; j < n; j += threads) {
    for (int i = 0; i < n; ++i) x[i * n + j] = i == j ? 1.0 : 0.0;
    for (int k = 0; k < rank; ++k) {
      double along = head[k] * x[k * n + j];
      for (int i = k + 1; i < n; ++i) along += a[i * n + k] * x[i * n + j];
      along *= beta[k];
      x[k * n + j] -= along * head[k];
      for (int i = k + 1; i < n; ++i) x[i * n + j] -= along * a[i * n + k];
    }
    for (int k = rank - 1; k >= 0; --k) {
      double sum = x[k * n + j];
      for (int c = k + 1; c < rank; ++c) sum -= a[k * n + c] * x[c * n + j];
      x[k * n + j] = sum / a[k * n + k];
    }
    for (int i = rank; i < n; ++i) x[i * n + j] = 0.0;
    for (int k = 0; k < rank && rank < n; ++k) {
      double along = z_head[k] * x[k * n + j];
      for (int c = rank; c < n; ++c) along += a[k * n + c] * x[c * n + j];
      along *= z_beta[k];
      x[k * n + j] -= along * z_head[k];
      for (int c = rank; c < n; ++c) x[c * n + j] -= along * a[k * n + c];
    }
    for (int i = 0; i < n; ++i) out[order[i] * n + j] = static_cast<T>(scale[order[i]] * scale[j] * x[i * n + j]);
  }
}

}  // namespace prdp::gpu
