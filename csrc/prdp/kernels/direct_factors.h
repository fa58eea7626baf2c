#pragma once
#include <Eigen/Dense>
#include <functional>
#include <memory>
#include <numbers>

#include "prdp/kernels/factor_cache.h"
#include "prdp/kernels/laplacian.h"
#include "prdp/kernels/matrix.h"
#include "prdp/kernels/sparse_factors.h"

/// The exact methods of each operator. A factorisation is made once and used for any number of right-hand sides. Each
/// has solve(r, d), which sets d = A⁻¹ r in the kernel's padded layout and returns false if A is singular.
namespace prdp::kernels {

template <class T>
bool all_finite(const T* x, int64_t n) {
  return std::isfinite(largest_magnitude(x, n));
}

template <class T, int Dim>
class LaplacianFactors;

/// Thomas' algorithm for the constant tridiagonal matrix. The one division per row is done beforehand.
template <class T>
class LaplacianFactors<T, 1> {
 public:
  explicit LaplacianFactors(const Laplacian<T, 1>& kernel) : inverse_pivot_(kernel.unknowns()) {
    const LaplacianParameters& p = kernel.parameters();
    off_ = static_cast<T>(p.off[0]);
    double pivot = p.centre;
    for (auto& inverse : inverse_pivot_) {
      inverse = static_cast<T>(1.0 / pivot);
      pivot = p.centre - p.off[0] * p.off[0] / pivot;
    }
  }
  bool solve(const T* r, T* d) const {
    const auto n = static_cast<int64_t>(inverse_pivot_.size());
    T previous = 0;
    for (int64_t i = 0; i < n; ++i) d[i] = previous = (r[i] - off_ * previous) * inverse_pivot_[i];
    for (int64_t i = n - 2; i >= 0; --i) d[i] -= off_ * inverse_pivot_[i] * d[i + 1];
    return all_finite(d, n);
  }

 private:
  T off_;
  std::vector<T> inverse_pivot_;
};

/// Diagonalisation by the sine transform in 2D and 3D: small matrix products along each axis.
template <class T, int Dim>
class LaplacianFactors {
 public:
  explicit LaplacianFactors(const Laplacian<T, Dim>& kernel)
      : kernel_(kernel),
        nz_(Dim > 2 ? kernel.parameters().shape[0] : 1),
        ny_(kernel.parameters().shape[Dim - 2]),
        nx_(kernel.parameters().shape[Dim - 1]),
        inverse_(kernel.unknowns()),
        field_(kernel.unknowns()),
        other_(kernel.unknowns()) {
    const LaplacianParameters& p = kernel.parameters();
    basis_[0] = basis(nx_);
    basis_[1] = basis(ny_);
    if (Dim > 2) basis_[2] = basis(nz_);
    int64_t at = 0;
    for (int64_t k = 1; k <= nz_; ++k)
      for (int64_t j = 1; j <= ny_; ++j)
        for (int64_t i = 1; i <= nx_; ++i) {
          // Along one axis, off (v_{i-1} + v_{i+1}) has the eigenvalues 2 off cos(π k / (N + 1)).
          double value = p.centre + 2.0 * p.off[Dim - 1] * cosine(i, nx_) + 2.0 * p.off[Dim - 2] * cosine(j, ny_);
          if constexpr (Dim > 2) value += 2.0 * p.off[0] * cosine(k, nz_);
          inverse_[at++] = static_cast<T>(1.0 / value);
        }
  }
  bool solve(const T* r, T* d) const {
    kernel_.store(r, T(1), field_.data());
    transform();
    for (size_t i = 0; i < field_.size(); ++i) field_[i] *= inverse_[i];
    transform();
    kernel_.load(field_.data(), T(1), d);
    return all_finite(field_.data(), static_cast<int64_t>(field_.size()));
  }

 private:
  using Matrix = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  using View = Eigen::Map<Matrix>;

  static double cosine(int64_t k, int64_t n) {
    return std::cos(std::numbers::pi * static_cast<double>(k) / static_cast<double>(n + 1));
  }
  /// S_jk = √(2/(N+1)) sin(π j k/(N+1)), symmetric and its own inverse.
  static Matrix basis(int64_t n) {
    std::vector<double> sine(2 * (n + 1));
    for (int64_t m = 0; m < 2 * (n + 1); ++m)
      sine[m] = std::sqrt(2.0 / static_cast<double>(n + 1)) *
                std::sin(std::numbers::pi * static_cast<double>(m) / static_cast<double>(n + 1));
    Matrix s(n, n);
    for (int64_t j = 0; j < n; ++j)
      for (int64_t k = 0; k < n; ++k) s(j, k) = static_cast<T>(sine[(j + 1) * (k + 1) % (2 * (n + 1))]);
    return s;
  }
  /// field_ ← S field_ along every axis; the axes commute.
  void transform() const {
    View(other_.data(), nz_ * ny_, nx_).noalias() = View(field_.data(), nz_ * ny_, nx_) * basis_[0];
    for (int64_t z = 0; z < nz_; ++z)
      View(field_.data() + z * ny_ * nx_, ny_, nx_).noalias() =
          basis_[1] * View(other_.data() + z * ny_ * nx_, ny_, nx_);
    if constexpr (Dim > 2) {
      View(other_.data(), nz_, ny_ * nx_).noalias() = basis_[2] * View(field_.data(), nz_, ny_ * nx_);
      field_.swap(other_);
    }
  }

  const Laplacian<T, Dim>& kernel_;
  int64_t nz_, ny_, nx_;
  std::vector<T> inverse_;
  Matrix basis_[3];
  mutable std::vector<T> field_, other_;  // one object a thread
};

/// LU with partial pivoting by Eigen.
template <class T>
class DenseFactors {
 public:
  explicit DenseFactors(const Dense<T>& a) : n_(a.unknowns()) {
    Matrix m(n_, n_);
    for (int64_t i = 0; i < n_; ++i)
      for (int64_t j = 0; j < n_; ++j) m(i, j) = a.at(i, j);
    lu_.compute(m);
  }
  bool solve(const T* r, T* d) const {
    using Vector = Eigen::Matrix<T, Eigen::Dynamic, 1>;
    Eigen::Map<Vector>(d, n_) = lu_.solve(Eigen::Map<const Vector>(r, n_));
    return all_finite(d, n_);
  }

 private:
  using Matrix = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic>;
  int64_t n_;
  Eigen::PartialPivLU<Matrix> lu_;
};

/// Eigen's sparse factors. Its ordering and factorisation may not return if a row or a column is empty.
template <class T>
class CsrFactors {
 public:
  explicit CsrFactors(const Csr<T>& a) : n_(a.unknowns()), singular_(has_empty_line(a)) {
    if (singular_) return;
    sparse_ = factor_cache::find_or_make<SparseFactors<T>>(a.key(),
                                                           [&] { return std::make_shared<SparseFactors<T>>(a, n_); });
  }
  bool solve(const T* r, T* d) const {
    if (singular_ || !sparse_->is_regular()) return false;
    using Vector = Eigen::Matrix<T, Eigen::Dynamic, 1>;
    const Vector x = sparse_->solve(Eigen::Map<const Vector>(r, n_));
    std::copy(x.data(), x.data() + n_, d);
    return all_finite(d, n_);
  }

 private:
  static bool has_empty_line(const Csr<T>& a) {
    std::vector<char> row(a.unknowns()), column(a.unknowns());
    a.for_each_entry([&](int64_t i, int64_t j, T) { row[i] = column[j] = 1; });
    return !std::all_of(row.begin(), row.end(), std::identity{}) ||
           !std::all_of(column.begin(), column.end(), std::identity{});
  }

  int64_t n_;
  bool singular_;
  std::shared_ptr<const SparseFactors<T>> sparse_;
};

/// The direct method that belongs to a kernel.
template <class Kernel>
struct FactorsOf;
template <class T, int Dim>
struct FactorsOf<Laplacian<T, Dim>> {
  using Type = LaplacianFactors<T, Dim>;
};
template <class T>
struct FactorsOf<Dense<T>> {
  using Type = DenseFactors<T>;
};
template <class T>
struct FactorsOf<Csr<T>> {
  using Type = CsrFactors<T>;
};

}  // namespace prdp::kernels
