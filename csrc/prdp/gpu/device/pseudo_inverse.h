#pragma once
#include <cmath>
#include <cstdint>

#include "prdp/gpu/device/views.h"
#include "prdp/kernels/coarsening.h"

/// The inverse of a small matrix, and of a singular one the pseudo-inverse, by the threads of one block: a complete
/// orthogonal decomposition A P = Q [T 0; 0 0] Zᵀ by Householder's reflections (Golub and Van Loan 2013, section 5.5).
namespace prdp::gpu {

/// The decomposition in a block's memory. Its threads take each step together.
template <int threads>
struct OrthogonalDecomposition {
  OrthogonalDecomposition(int size, double* work)
      : n(size),
        a(work),
        x(a + n * n),
        scale(x + n * n),
        norm2(scale + n),
        heads(norm2 + n),
        betas(heads + n),
        z_heads(betas + n),
        z_betas(z_heads + n),
        of_row(reinterpret_cast<uint64_t*>(z_betas + n)),
        of_column(of_row + n),
        order(reinterpret_cast<int*>(of_column + n)) {}

  /// Brings A to the order of one: what is tiny may only be so beside a larger diagonal.
  void balance() {
    for (int i = thread; i < n; i += threads) {
      const double d = std::abs(a[i * n + i]);
      scale[i] = d == 0.0 ? 1.0 : std::ldexp(1.0, -std::ilogb(d) / 2);
      order[i] = i;
      of_row[i] = 0;
      for (int j = 0; j < n; ++j)
        if (a[i * n + j] != 0.0) of_row[i] |= uint64_t{1} << j;
    }
    __syncthreads();
    for (int j = thread; j < n; j += threads) {
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
    const bool all_are_there = nullity == 0 || kernels::count_parts(n, of_row, of_column) >= nullity;
    double first = 0;
    for (; rank < n; ++rank) {
      int pivot = rank;
      for (int j = rank + 1; j < n; ++j)
        if (norm2[j] > norm2[pivot]) pivot = j;
      const double size = std::sqrt(norm2[pivot]);
      if (rank == 0) first = size;
      const bool is_null = rank >= n - nullity && (all_are_there || size < 1e-3 * first);
      if (is_null || !(size > tiny * first)) break;
      for (int i = thread; i < n; i += threads) std::swap(a[i * n + rank], a[i * n + pivot]);
      if (thread == 0) std::swap(order[rank], order[pivot]);
      __syncthreads();
      const double alpha = a[rank * n + rank], head = alpha + (alpha < 0 ? -size : size);
      const double beta = 1.0 / (size * (size + std::abs(alpha)));
      for (int j = rank + 1 + thread; j < n; j += threads)
        norm2[j] = reflect(head, beta, a[rank * n + j], column_of(a, rank), column_of(a, j), rank + 1, n);
      __syncthreads();
      if (thread == 0) {
        a[rank * n + rank] = alpha < 0 ? size : -size;
        heads[rank] = head;
        betas[rank] = beta;
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
      const double head = alpha + (alpha < 0 ? -size : size), beta = 1.0 / (size * (size + std::abs(alpha)));
      for (int i = thread; i < k; i += threads) reflect(head, beta, a[i * n + k], row_of(a, k), row_of(a, i), rank, n);
      __syncthreads();
      if (thread == 0) {
        a[k * n + k] = alpha < 0 ? size : -size;
        z_heads[k] = head;
        z_betas[k] = beta;
      }
    }
    __syncthreads();
  }

  /// Column j of P Z T⁻¹ Qᵀ, in x.
  void solve_for_column(int j) {
    for (int i = 0; i < n; ++i) x[i * n + j] = i == j ? 1.0 : 0.0;
    for (int k = 0; k < rank; ++k)
      reflect(heads[k], betas[k], x[k * n + j], column_of(a, k), column_of(x, j), k + 1, n);
    for (int k = rank - 1; k >= 0; --k) {
      double sum = x[k * n + j];
      for (int c = k + 1; c < rank; ++c) sum -= a[k * n + c] * x[c * n + j];
      x[k * n + j] = sum / a[k * n + k];
    }
    for (int i = rank; i < n; ++i) x[i * n + j] = 0.0;
    for (int k = 0; k < rank && rank < n; ++k)
      reflect(z_heads[k], z_betas[k], x[k * n + j], row_of(a, k), column_of(x, j), rank, n);
  }

  /// A column or a row of a matrix.
  struct Line {
    double* first;
    int step;
    double& operator[](int i) const { return first[i * step]; }
  };
  Line column_of(double* matrix, int j) const { return {matrix + j, n}; }
  Line row_of(double* matrix, int i) const { return {matrix + i * n, 1}; }

  /// (first, x) minus beta v (v·(first, x)), where v is (head, tail), of the entries begin … end - 1. Returns ‖x‖².
  static double reflect(double head, double beta, double& first, Line tail, Line x, int begin, int end) {
    double dot = head * first, x2 = 0;
    for (int i = begin; i < end; ++i) dot += tail[i] * x[i];
    dot *= beta;
    first -= dot * head;
    for (int i = begin; i < end; ++i) {
      const double left = x[i] -= dot * tail[i];
      x2 += left * left;
    }
    return x2;
  }

  const int n, thread = static_cast<int>(threadIdx.x);
  int rank = 0;
  double *const a, *const x, *const scale, *const norm2, *const heads, *const betas, *const z_heads, *const z_betas;
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
  OrthogonalDecomposition<threads> parts(n, work);
  parts.balance();
  parts.triangularise(nullity, tiny);
  parts.annihilate_trailing_columns();
  T largest = 0;
  for (int j = parts.thread; j < n; j += threads) {
    parts.solve_for_column(j);
    for (int i = 0; i < n; ++i) {
      const T value = static_cast<T>(parts.scale[parts.order[i]] * parts.scale[j] * parts.x[i * n + j]);
      out[parts.order[i] * n + j] = value;
      largest = larger_or_nan(largest, std::abs(value));
    }
  }
  return largest;
}

}  // namespace prdp::gpu
