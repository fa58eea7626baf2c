#pragma once
#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>
#include <vector>

#include "prdp/kernels/factor_cache.h"
#include "prdp/kernels/kernel.h"

namespace prdp::kernels {

/// What the two kinds of matrices share: a vector is n values, padded at its end, and the Jacobi sweep follows from the
/// product and the diagonal.
template <class T>
class MatrixKernel : public Kernel<T> {
 public:
  bool has_zero_diagonal() const final {
    return std::find(diagonal_.begin(), diagonal_.end(), T(0)) != diagonal_.end();
  }
  void divide_by_diagonal(const T* b, T* c) const final {
    for (int64_t i = 0; i < n(); ++i) c[i] = b[i] / diagonal_[i];
  }
  void jacobi_sweeps(const T* c, T*& x, T*& y, int64_t n, const T*) const final {
    for (; n > 0; --n, std::swap(x, y)) sweep<false>(c, x, y);
  }
  T jacobi_sweep(const T* c, const T* x, T* y, const T*) const final { return sweep<true>(c, x, y); }

 protected:
  MatrixKernel(int64_t n, T factor) : Kernel<T>(Layout<T>::of_fields(1, 1, n), factor), diagonal_(n, T(0)) {}
  int64_t n() const { return static_cast<int64_t>(diagonal_.size()); }
  /// Values of the matrix as the products need them: those given, or scaled in memory of this kernel.
  const T* scaled(const T* values, int64_t count) {
    if (Kernel<T>::factor() == T(1)) return values;
    memory_.resize(static_cast<size_t>(count));
    std::transform(values, values + count, memory_.begin(), [f = Kernel<T>::factor()](T a) { return f * a; });
    return memory_.data();
  }

  /// Calls body(begin, end) for parts of at least so many rows, which several threads may share; `work` is that of all.
  template <class Body>
  void for_each_part(int64_t work, int64_t least, const Body& body) const {
    const int64_t each = std::max<int64_t>(kBlock * n() / std::max<int64_t>(work, 1), least);
    share_rows::for_each((n() + each - 1) / each, [&](int64_t p) { body(p * each, std::min(n(), (p + 1) * each)); });
  }

  std::vector<T> diagonal_;

 private:
  template <bool Measure>
  T sweep(const T* c, const T* x, T* y) const {
    this->apply(x, y);
    T residual = 0;
    for (int64_t i = 0; i < n(); ++i) {
      const T d = diagonal_[i], change = c[i] - y[i] / d;
      y[i] = x[i] + change;
      if constexpr (Measure) residual += d * change * d * change;
    }
    return residual;
  }

  std::vector<T> memory_;
};

/// A dense row-major matrix, or its transpose.
template <class T>
class Dense final : public MatrixKernel<T> {
 public:
  /// `magnitude` is that of the largest entry.
  Dense(const T* matrix, int64_t n, bool transposed, T magnitude)
      : MatrixKernel<T>(n, scale_of_operator(magnitude)), a_(this->scaled(matrix, n * n)), transposed_(transposed) {
    for (int64_t i = 0; i < n; ++i) this->diagonal_[i] = a_[i * n + i];
  }

  int64_t work() const override { return n() * n() + n(); }
  /// The matrix that is not transposed.
  const T* values() const { return a_; }
  bool transposed() const { return transposed_; }
  void apply(const T* v, T* out) const override { multiply(&v, &out, 1, n()); }
  bool apply_to_several(const T* const* v, T* const* out, int64_t count) const override {
    constexpr int64_t columns = 64;  // at once, so that the cache holds them for all vectors
    multiply(v, out, count, columns);
    return true;
  }
  double norm() const override {
    std::vector<double> sums(n(), 0.0);  // of the rows of the matrix as applied
    for (int64_t i = 0; i < n(); ++i) {
      const T* row = a_ + i * n();
      if (transposed_)
        for (int64_t j = 0; j < n(); ++j) sums[j] += std::abs(row[j]);
      else sums[i] = std::accumulate(row, row + n(), 0.0, [](double sum, T a) { return sum + std::abs(a); });
    }
    return std::accumulate(sums.begin(), sums.end(), 0.0, [](double a, double b) { return std::max(a, b); });
  }
  std::shared_ptr<const Factors<T>> factorise() const override;

 private:
  using MatrixKernel<T>::n;

  /// `columns`: of the matrix, at once, where its transpose is applied.
  void multiply(const T* const* v, T* const* out, int64_t count, int64_t columns) const {
    if (!transposed_) {
      return this->for_each_part(work(), 1, [&](int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i)
          for (int64_t k = 0; k < count; ++k) out[k][i] = loops_.dot(a_ + i * n(), v[k], n());
      });
    }
    constexpr int64_t least = 128;  // columns, so that pieces of rows fill whole cache lines
    this->for_each_part(work(), least, [&](int64_t begin, int64_t end) {
      for (; begin < end; begin += columns) {
        const int64_t size = std::min(columns, end - begin);
        for (int64_t k = 0; k < count; ++k) {
          std::fill_n(out[k] + begin, size, T(0));
          loops_.add_rows(v[k], a_ + begin, n(), n(), out[k] + begin, size);
        }
      }
    });
  }

  const Loops<T>& loops_ = loops<T>();
  const T* a_;
  bool transposed_;
};

/// A matrix in compressed sparse rows, or its transpose, whose rows it makes.
template <class T>
class Csr final : public MatrixKernel<T> {
 public:
  /// `magnitude` is that of the largest value.
  Csr(const int64_t* crow, const int64_t* col, const T* values, int64_t n, bool transposed, T magnitude)
      : MatrixKernel<T>(n, scale_of_operator(magnitude)),
        given_crow_(crow),
        given_col_(col),
        given_values_(values),
        transposed_(transposed),
        crow_(crow),
        col_(col),
        values_(this->scaled(values, crow[n])) {
    if (transposed) transpose();
    for_each_entry([&](int64_t i, int64_t j, T a) { this->diagonal_[i] += i == j ? a : T(0); });
  }

  int64_t stored() const { return crow_[n()]; }
  int64_t work() const override { return stored() + n(); }
  void apply(const T* v, T* out) const override {
    this->for_each_part(work(), 1, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        double sum = 0;  // a row may have thousands of entries
        for (int64_t k = crow_[i]; k < crow_[i + 1]; ++k) sum += static_cast<double>(values_[k]) * v[col_[k]];
        out[i] = static_cast<T>(sum);
      }
    });
  }
  /// Calls body(row, column, value) for every stored entry of the matrix as applied.
  template <class Body>
  void for_each_entry(const Body& body) const {
    for (int64_t i = 0; i < n(); ++i)
      for (int64_t k = crow_[i]; k < crow_[i + 1]; ++k) body(i, col_[k], values_[k]);
  }
  double norm() const override {
    double largest = 0;
    for (int64_t i = 0; i < n(); ++i) {
      double sum = 0;
      for (int64_t k = crow_[i]; k < crow_[i + 1]; ++k) sum += std::abs(values_[k]);
      largest = std::max(largest, sum);
    }
    return largest;
  }
  std::shared_ptr<const Factors<T>> factorise() const override;

  /// Tells the matrix from others, the same for its transpose.
  FactorKey key() const {
    FactorKeyMaker key;
    return key.add(n()).add(given_crow_, n() + 1).add(given_col_, stored()).add(given_values_, stored()).key();
  }
  bool transposed() const { return transposed_; }

 private:
  using MatrixKernel<T>::n;

  void transpose() {
    own_crow_.assign(n() + 1, 0);
    own_col_.resize(stored());
    own_values_.resize(stored());
    for (int64_t k = 0; k < stored(); ++k) ++own_crow_[col_[k] + 1];
    for (int64_t i = 0; i < n(); ++i) own_crow_[i + 1] += own_crow_[i];
    auto next = own_crow_;
    for_each_entry([&](int64_t i, int64_t j, T a) {
      own_col_[next[j]] = i;
      own_values_[next[j]++] = a;
    });
    crow_ = own_crow_.data();
    col_ = own_col_.data();
    values_ = own_values_.data();
  }

  const int64_t *given_crow_, *given_col_;
  const T* given_values_;
  bool transposed_;
  const int64_t *crow_, *col_;
  const T* values_;
  std::vector<int64_t> own_crow_, own_col_;
  std::vector<T> own_values_;
};

}  // namespace prdp::kernels
