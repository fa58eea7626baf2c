#pragma once
#include <cmath>
#include <cstdint>

#include "prdp/gpu/device/views.h"

/// The inverse of a small matrix, and of a singular one the pseudo-inverse, by the threads of one block: a complete
/// orthogonal decomposition A P = Q [T 0; 0 0] Zᵀ by Householder's reflections (Golub and Van Loan 2013, section 5.5).
namespace prdp::gpu {

/// How many parts of at least two points there are that nothing couples to each other, where bit j of of_row[i] says
/// whether there is an entry (i, j), and bit i of of_column[j] too.
inline int count_parts(int n, const uint64_t* of_row, const uint64_t* of_column) {
  uint64_t seen = 0;
  int parts = 0;
  for (int first = 0; first < n; ++first) {
    if (seen >> first & 1) continue;
    uint64_t part = uint64_t{1} << first, before = 0;
    while (part != before) {
      before = part;
      for (int i = first; i < n; ++i)
        if (part >> i & 1) part |= of_row[i] | of_column[i];
    }
    seen |= part;
    parts += (part & (part - 1)) != 0;
  }
  return parts;
}

/// The decomposition in a block's memory. Its threads take each step together; t is the number of this one.
template <int threads>
struct OrthogonalDecomposition {
  OrthogonalDecomposition(int size, double* work)
      : n(size),
        a(work),
        x(a + n * n),
        scale(x + n * n),
        norm2(scale + n),
        head(norm2 + n),
        beta(head + n),
        z_head(beta + n),
        z_beta(z_head + n),
        of_row(reinterpret_cast<uint64_t*>(z_beta + n)),
        of_column(of_row + n),
        order(reinterpret_cast<int*>(of_column + n)) {}

  /// Brings A to the order of one: what is tiny may only be so beside a larger diagonal.
  void balance() {
    for (int i = t; i < n; i += threads) {
      const double d = std::abs(a[i * n + i]);
      scale[i] = d == 0.0 ? 1.0 : std::ldexp(1.0, -std::ilogb(d) / 2);
      order[i] = i;
      of_row[i] = 0;
      for (int j = 0; j < n; ++j)
        if (a[i * n + j] != 0.0) of_row[i] |= uint64_t{1} << j;
    }
    __syncthreads();
    for (int j = t; j < n; j += threads) {
      double sum = 0;
      of_column[j] = 0;
      for (int i = 0; i < n; ++i) {
        const double v = a[i * n + j] *= scale[i] * scale[j];
        sum += v * v;
        if (v != 0.0) of_column[j] |= uint64_t{1} << i;
      }
      norm2[j] = sum;
    }
    __syncthreads();
  }

  /// A P = Q R: each thread has columns of its own.
  void triangularise(int nullity, double tiny) {
    const bool all_are_there = nullity == 0 || count_parts(n, of_row, of_column) >= nullity;
    double first = 0;
    for (; rank < n; ++rank) {
      int pivot = rank;
      for (int j = rank + 1; j < n; ++j)
        if (norm2[j] > norm2[pivot]) pivot = j;
      const double size = std::sqrt(norm2[pivot]);
      if (rank == 0) first = size;
      const bool is_null = rank >= n - nullity && (all_are_there || size < 1e-3 * first);
      if (is_null || !(size > tiny * first)) break;
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
  }

  /// What R has beside its first columns goes into them: each thread has rows of its own.
  void annihilate_trailing_columns() {
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
  }

  /// Column j of P Z T⁻¹ Qᵀ, in x.
  void solve_for_column(int j) {
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
  }

  const int n, t = static_cast<int>(threadIdx.x);
  int rank = 0;
  double *const a, *const x, *const scale, *const norm2, *const head, *const beta, *const z_head, *const z_beta;
  uint64_t *const of_row, *const of_column;  // as count_parts() takes them
  int* const order;                          // P
};

/// `work` begins with A (n, n), whose rows the threads have written in turn, and which is overwritten; the inverse goes
/// to `out`, (n, n) too. What is below `tiny` beside the largest is left out. Of a null space of `nullity` dimensions,
/// rounding of the coefficients may have made the matrix regular, and its inverse would be rounding all the same: so
/// many are left out, unless the null vectors of pockets are gone on so coarse a grid. Returns the largest number that
/// this thread wrote.
template <int threads, class T>
PRDP_NOINLINE T pseudo_inverse(int n, double* work, int nullity, double tiny, T* out) {
  OrthogonalDecomposition<threads> of(n, work);
  of.balance();
  of.triangularise(nullity, tiny);
  of.annihilate_trailing_columns();
  T largest = 0;
  for (int j = of.t; j < n; j += threads) {
    of.solve_for_column(j);
    for (int i = 0; i < n; ++i) {
      const T value = static_cast<T>(of.scale[of.order[i]] * of.scale[j] * of.x[i * n + j]);
      out[of.order[i] * n + j] = value;
      largest = larger_or_nan(largest, std::abs(value));
    }
  }
  return largest;
}

}  // namespace prdp::gpu
