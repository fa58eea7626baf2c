#include <Eigen/Dense>
#include <limits>
#include <optional>

#include "prdp/kernels/equilibration.h"
#include "prdp/kernels/matrix.h"
#include "prdp/kernels/sparse_factors.h"

namespace prdp::kernels {

namespace {

template <class T>
using Values = Eigen::Matrix<T, Eigen::Dynamic, 1>;

/// d_i = A⁻¹ r_i, or A⁻ᵀ r_i, by these factors; false if one is not finite.
template <class T, class F>
bool solve_columns(const F& factors, const T* const* r, T* const* d, int64_t count, int64_t n, bool transposed) {
  Eigen::MatrixXd x(n, count);
  for (int64_t i = 0; i < count; ++i) x.col(i) = Eigen::Map<const Values<T>>(r[i], n).template cast<double>();
  factors.solve(x, transposed);
  bool finite = true;
  for (int64_t i = 0; i < count; ++i) {
    Eigen::Map<Values<T>> found(d[i], n);
    found = x.col(i).template cast<T>();
    finite &= found.allFinite();
  }
  return finite;
}

/// LU with partial pivoting, in double whatever the dtype of the matrix. Where that finds no regular matrix, the rows
/// and columns may only differ much in size: they are scaled, and factored again.
class DenseLU {
 public:
  explicit DenseLU(const Eigen::MatrixXd& m) : rows_(m.rows()) {
    factor(m);
    if (is_regular_) return;
    const auto scales = equilibrate(m.rows(), [&](const auto& body) {
      for (Eigen::Index j = 0; j < m.cols(); ++j)
        for (Eigen::Index i = 0; i < m.rows(); ++i) body(i, j, m(i, j));
    });
    if (!scales.matters()) return;
    factor(scales.rows.asDiagonal() * m * scales.columns.asDiagonal());
    scales_ = scales;
  }
  bool is_regular() const { return is_regular_; }
  /// x ← A⁻¹ x, or A⁻ᵀ x, for each column.
  void solve(Eigen::Ref<Eigen::MatrixXd> x, bool transposed) const {
    for (Eigen::Index column = 0, power = 3; column < x.cols(); column += Eigen::Index{1} << power) {
      while (column + (Eigen::Index{1} << power) > x.cols()) --power;
      solve_block(x.middleCols(column, Eigen::Index{1} << power), power, transposed);
    }
  }
  int64_t bytes() const { return memory_.size() * static_cast<int64_t>(sizeof(double)); }

 private:
  using SideBySide = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  /// A pivot is rounding beside its own column: how large the others are does not matter.
  void factor(const Eigen::MatrixXd& m) {
    const int64_t n = m.rows();
    const double rounding = std::numeric_limits<double>::epsilon() * static_cast<double>(n);
    const Eigen::ArrayXd sizes = m.cwiseAbs().colwise().sum();
    memory_.resize(n % 64 == 0 ? n + 8 : n, n);
    memory_.topRows(n) = m;
    loops<double>().factor_lu(memory_.data(), memory_.rows(), n, rows_.data());
    is_regular_ = (memory_.diagonal().cwiseAbs().array() > rounding * sizes).all();
  }
  /// Of 2^power columns.
  void solve_block(Eigen::Ref<Eigen::MatrixXd> x, Eigen::Index power, bool transposed) const {
    if (scales_) x.array().colwise() *= (transposed ? scales_->columns : scales_->rows).array();
    SideBySide side_by_side = transposed ? SideBySide(x) : SideBySide(x(rows_, Eigen::all));
    loops<double>().solve_lu[power](memory_.data(), memory_.rows(), x.rows(), side_by_side.data(), transposed);
    if (transposed) x(rows_, Eigen::all) = side_by_side;
    else x = side_by_side;
    if (scales_) x.array().colwise() *= (transposed ? scales_->rows : scales_->columns).array();
  }

  Eigen::MatrixXd memory_;  // L and U, with rows below them where columns would else compete for places in the cache
  std::vector<int64_t> rows_;  // of P
  std::optional<Equilibration> scales_;
  bool is_regular_ = false;
};

/// A null space that is named is filled: A + s Σ l_k r_kᵀ is regular.
template <class T>
class DenseFactors final : public Factors<T> {
 public:
  explicit DenseFactors(const Dense<T>& a) : n_(a.unknowns()), transposed_(a.transposed()) {
    const auto make = [&] {
      Eigen::MatrixXd m = Eigen::Map<const RowMajor>(a.values(), n_, n_).template cast<double>();
      if (!a.null_space()) return std::make_shared<DenseLU>(m);
      const double size = m.cwiseAbs().maxCoeff() * static_cast<double>(n_);
      auto right = a.null_space()->in_one_field(), left = a.left_null_space()->in_one_field();
      if (transposed_) right.swap(left);
      for (size_t k = 0; k < right.size(); ++k) m += size * vector(left[k]) * vector(right[k]).transpose();
      return std::make_shared<DenseLU>(m);
    };
    constexpr int64_t worth_keeping = 16;  // unknowns: the key of a smaller matrix takes as long as its factors
    if (a.null_space() || n_ < worth_keeping) lu_ = make();
    else lu_ = factor_cache::find_or_make<DenseLU>(FactorKeyMaker().add(n_).add(a.values(), n_ * n_).key(), make);
  }
  bool gains_by_several() const override { return true; }
  bool solve(const T* r, T* d) const override { return solve_several(&r, &d, 1); }
  bool solve_several(const T* const* r, T* const* d, int64_t count) const override {
    return lu_->is_regular() && solve_columns<T>(*lu_, r, d, count, n_, transposed_);
  }

 private:
  using RowMajor = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  static Eigen::Map<const Eigen::VectorXd> vector(const std::vector<double>& v) {
    return {v.data(), static_cast<Eigen::Index>(v.size())};
  }

  int64_t n_;
  bool transposed_;
  std::shared_ptr<const DenseLU> lu_;
};

template <class T>
class CsrFactors final : public Factors<T> {
 public:
  explicit CsrFactors(const Csr<T>& a)
      : n_(a.unknowns()),
        transposed_(a.transposed()),
        sparse_(sparse_factors(a, a.key(), a.transposed(), n_, pins_of(a.null_space(), a.left_null_space(), 0))) {}
  bool gains_by_several() const override { return sparse_->gains_by_several(); }
  bool solve(const T* r, T* d) const override { return solve_several(&r, &d, 1); }
  bool solve_several(const T* const* r, T* const* d, int64_t count) const override {
    return sparse_->is_regular() && solve_columns<T>(*sparse_, r, d, count, n_, transposed_);
  }

 private:
  int64_t n_;
  bool transposed_;
  std::shared_ptr<const SparseFactors> sparse_;
};

}  // namespace

template <class T>
std::shared_ptr<const Factors<T>> Dense<T>::factorise() const {
  return std::make_shared<DenseFactors<T>>(*this);
}
template <class T>
std::shared_ptr<const Factors<T>> Csr<T>::factorise() const {
  return std::make_shared<CsrFactors<T>>(*this);
}

template std::shared_ptr<const Factors<float>> Dense<float>::factorise() const;
template std::shared_ptr<const Factors<double>> Dense<double>::factorise() const;
template std::shared_ptr<const Factors<float>> Csr<float>::factorise() const;
template std::shared_ptr<const Factors<double>> Csr<double>::factorise() const;

}  // namespace prdp::kernels
