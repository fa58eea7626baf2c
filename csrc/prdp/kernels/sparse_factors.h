#pragma once
#include <Eigen/Sparse>
#include <Eigen/SparseCholesky>
#include <Eigen/SparseLU>
#include <algorithm>
#include <optional>
#include <vector>

namespace prdp::kernels {

/// Factors of a sparse matrix by Eigen: Cholesky's if the matrix is symmetric and definite of either sign, which takes
/// a quarter of the time, otherwise LU with pivoting. Once they are made, any thread may solve with them.
template <class T>
class SparseFactors {
 public:
  using Vector = Eigen::Matrix<T, Eigen::Dynamic, 1>;

  /// Of the first n rows and columns of the kernel's matrix.
  template <class Kernel>
  SparseFactors(const Kernel& kernel, int64_t n) {
    std::vector<Eigen::Triplet<T>> entries;
    kernel.for_each_entry([&](int64_t i, int64_t j, auto value) {
      if (i < n && j < n) entries.emplace_back(static_cast<int>(i), static_cast<int>(j), static_cast<T>(value));
    });
    Matrix m(n, n);
    m.setFromTriplets(entries.begin(), entries.end());
    if (is_symmetric(m)) {
      if (m.coeff(0, 0) < T(0)) sign_ = T(-1);
      cholesky_.emplace(Matrix(sign_ * m));
      if (cholesky_->info() == Eigen::Success) return;
      cholesky_.reset();
    }
    lu_.emplace(m);
  }
  bool is_regular() const { return cholesky_ || lu_->info() == Eigen::Success; }
  template <class Rhs>
  Vector solve(const Rhs& rhs) const {
    if (cholesky_) return sign_ * cholesky_->solve(rhs);
    return lu_->solve(rhs);
  }
  int64_t bytes() const {
    const int64_t stored = cholesky_      ? cholesky_->matrixL().nestedExpression().nonZeros()
                           : is_regular() ? int64_t{lu_->nnzL()} + lu_->nnzU()
                                          : 0;
    return stored * static_cast<int64_t>(sizeof(T) + sizeof(int));
  }

 private:
  using Matrix = Eigen::SparseMatrix<T>;

  static bool is_symmetric(const Matrix& m) {
    const Matrix t = m.transpose();
    return std::equal(m.outerIndexPtr(), m.outerIndexPtr() + m.outerSize() + 1, t.outerIndexPtr()) &&
           std::equal(m.innerIndexPtr(), m.innerIndexPtr() + m.nonZeros(), t.innerIndexPtr()) &&
           std::equal(m.valuePtr(), m.valuePtr() + m.nonZeros(), t.valuePtr());
  }

  T sign_ = 1;
  std::optional<Eigen::SimplicialLLT<Matrix>> cholesky_;
  std::optional<Eigen::SparseLU<Matrix>> lu_;
};

}  // namespace prdp::kernels
