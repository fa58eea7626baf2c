#pragma once
#include <algorithm>
#include <array>
#include <utility>
#include <vector>

#include "prdp/kernels/factor_cache.h"
#include "prdp/kernels/vector.h"

namespace prdp::kernels {

/// What the two kinds of matrices share: a vector is n values, padded at its end, and the Jacobi
/// sweep follows from the product and the diagonal.
template <class T, class Matrix>
class MatrixBase {
 public:
  using Scalar = T;

  explicit MatrixBase(int64_t n) : n_(n) {}
  int64_t unknowns() const { return n_; }
  int64_t length() const { return round_up_to_lanes<T>(n_); }
  int64_t halo() const { return 0; }
  void load(const T* src, T scale, T* dst) const {
    for (int64_t i = 0; i < n_; ++i) dst[i] = scale * src[i];
  }
  void store(const T* src, T scale, T* dst) const { load(src, scale, dst); }

  bool has_zero_diagonal() const {
    for (int64_t i = 0; i < n_; ++i)
      if (self().diagonal(i) == T(0)) return true;
    return false;
  }
  void divide_by_diagonal(const T* b, T* c) const {
    for (int64_t i = 0; i < n_; ++i) c[i] = b[i] / self().diagonal(i);
  }
  /// n Jacobi sweeps x ← x + D⁻¹(b - A x) with c = D⁻¹ b; y is memory that they use.
  void jacobi_sweeps(const T* c, T*& x, T*& y, int64_t n) const {
    for (; n > 0; --n, std::swap(x, y)) sweep<false>(c, x, y);
  }
  /// One of them, from x to y; returns ‖b - A x‖².
  T jacobi_sweep(const T* c, const T* x, T* y) const { return sweep<true>(c, x, y); }

 protected:
  int64_t n_;

 private:
  template <bool Measure>
  T sweep(const T* c, const T* x, T* y) const {
    self().apply(x, y);
    T residual = 0;
    for (int64_t i = 0; i < n_; ++i) {
      const T d = self().diagonal(i), change = c[i] - y[i] / d;
      y[i] = x[i] + change;
      if constexpr (Measure) residual += d * change * d * change;
    }
    return residual;
  }

  const Matrix& self() const { return static_cast<const Matrix&>(*this); }
};

/// A dense row-major matrix, or its transpose.
template <class T>
class Dense : public MatrixBase<T, Dense<T>> {
 public:
  /// `sample_stride` is 0 for a matrix that all samples share.
  Dense(const T* matrix, int64_t n, int64_t sample_stride, bool transposed)
      : MatrixBase<T, Dense<T>>(n), a_(matrix), sample_stride_(sample_stride), transposed_(transposed) {}

  Dense sample(int64_t s) const { return {a_ + s * sample_stride_, n_, 0, transposed_}; }
  bool is_shared() const { return sample_stride_ == 0; }
  T diagonal(int64_t i) const { return a_[i * n_ + i]; }
  int64_t stored() const { return n_ * n_; }
  T at(int64_t i, int64_t j) const { return transposed_ ? a_[j * n_ + i] : a_[i * n_ + j]; }
  /// Of the largest entry; NaN or Inf if one is not finite.
  T magnitude() const { return largest_magnitude(a_, n_ * n_); }
  bool operator_is_finite() const { return std::isfinite(magnitude()); }
  /// factor · this one, its entries in `memory`.
  Dense scaled(T factor, std::vector<T>& memory) const {
    memory.resize(static_cast<size_t>(n_ * n_));
    std::transform(a_, a_ + n_ * n_, memory.begin(), [factor](T a) { return factor * a; });
    return {memory.data(), n_, 0, transposed_};
  }

  void apply(const T* v, T* out) const {
    if (!transposed_) {
      for (int64_t i = 0; i < n_; ++i) out[i] = loops_.dot(a_ + i * n_, v, n_);
      return;
    }
    std::fill(out, out + n_, T(0));
    for (int64_t i = 0; i < n_; ++i) loops_.axpy(v[i], a_ + i * n_, out, n_);
  }
  double norm() const {
    double largest = 0;
    for (int64_t i = 0; i < n_; ++i) {
      double sum = 0;
      for (int64_t j = 0; j < n_; ++j) sum += std::abs(a_[i * n_ + j]);
      largest = std::max(largest, sum);
    }
    return largest;
  }

 private:
  using MatrixBase<T, Dense<T>>::n_;
  const Loops<T>& loops_ = kernels::loops<T>();
  const T* a_;
  int64_t sample_stride_;
  bool transposed_;
};

/// A matrix in compressed sparse rows, or its transpose.
template <class T>
class Csr : public MatrixBase<T, Csr<T>> {
 public:
  Csr(const int64_t* crow, const int64_t* col, const T* values, int64_t n, int64_t stored, bool is_shared,
      bool transposed)
      : MatrixBase<T, Csr<T>>(n),
        crow_(crow),
        col_(col),
        values_(values),
        stored_(stored),
        is_shared_(is_shared),
        transposed_(transposed) {
    if (!is_shared) return;
    diagonal_.assign(n, T(0));
    for_each_entry([&](int64_t i, int64_t j, T a) { diagonal_[i] += i == j ? a : T(0); });
  }

  Csr sample(int64_t s) const {
    if (is_shared_) return *this;
    return {crow_ + s * (n_ + 1), col_ + s * stored_, values_ + s * stored_, n_, stored_, true, transposed_};
  }
  bool is_shared() const { return is_shared_; }
  /// As Dense has them.
  T magnitude() const { return largest_magnitude(values_, stored_); }
  bool operator_is_finite() const { return std::isfinite(magnitude()); }
  Csr scaled(T factor, std::vector<T>& memory) const {
    memory.resize(static_cast<size_t>(stored_));
    std::transform(values_, values_ + stored_, memory.begin(), [factor](T a) { return factor * a; });
    return {crow_, col_, memory.data(), n_, stored_, true, transposed_};
  }
  T diagonal(int64_t i) const { return diagonal_[i]; }
  void apply(const T* v, T* out) const {
    std::fill(out, out + n_, T(0));
    for_each_entry([&](int64_t i, int64_t j, T a) { out[i] += a * v[j]; });
  }
  /// Calls body(row, column, value) for every stored entry of the matrix as applied.
  template <class Body>
  void for_each_entry(const Body& body) const {
    for (int64_t i = 0; i < n_; ++i)
      for (int64_t k = crow_[i]; k < crow_[i + 1]; ++k)
        transposed_ ? body(col_[k], i, values_[k]) : body(i, col_[k], values_[k]);
  }
  int64_t stored() const { return stored_; }
  /// All that the matrix is, for the factor cache.
  std::string key() const {
    std::string key;
    factor_cache::append(key, std::array{n_, stored_, int64_t{transposed_}}.data(), 3);
    factor_cache::append(key, crow_, n_ + 1);
    factor_cache::append(key, col_, stored_);
    factor_cache::append(key, values_, stored_);
    return key;
  }
  double norm() const {
    double largest = 0;
    for (int64_t i = 0; i < n_; ++i) {
      double sum = 0;
      for (int64_t k = crow_[i]; k < crow_[i + 1]; ++k) sum += std::abs(values_[k]);
      largest = std::max(largest, sum);
    }
    return largest;
  }

 private:
  using MatrixBase<T, Csr<T>>::n_;
  const int64_t *crow_, *col_;
  const T* values_;
  int64_t stored_;
  bool is_shared_, transposed_;
  std::vector<T> diagonal_;  // empty until sample() has picked one matrix
};

}  // namespace prdp::kernels
