#pragma once
#include "prdp/kernels/burgers.h"
#include "prdp/kernels/direct_factors.h"
#include "prdp/kernels/navier_stokes.h"

/// The exact methods of the upwind operators. All factorise and solve in double, whatever T is.
namespace prdp::kernels {

template <class T, int Dim>
class BurgersFactors;

/// Thomas' algorithm for all unknowns but the last one, which the wraps couple to both ends:
/// [[M, e], [f, c]] with M tridiagonal is solved by x_n = (r_n - f·M⁻¹r)/(c - f·M⁻¹e).
template <class T>
class BurgersFactors<T, 1> {
 public:
  explicit BurgersFactors(const Burgers<T, 1>& kernel)
      : n_(kernel.unknowns()), lower_(n_), inverse_pivot_(n_), upper_(n_), column_(n_), work_(n_) {
    const int64_t last = n_ - 1;
    double corner = 0;
    std::vector<double> pivot(n_), border(n_);
    // Where n is 2 or 3, entries coincide and add up.
    kernel.for_each_entry([&](int64_t i, int64_t j, T value) {
      double& entry = i == last ? (j == last ? corner : border[j])
                      : j == last ? column_[i] : j < i ? lower_[i] : j > i ? upper_[i] : pivot[i];
      entry += static_cast<double>(value);
    });
    for (int64_t i = 0; i < last; ++i) {
      if (i > 0) pivot[i] -= lower_[i] * inverse_pivot_[i - 1] * upper_[i - 1];
      inverse_pivot_[i] = 1.0 / pivot[i];
    }
    border_first_ = last > 0 ? border[0] : 0.0;
    border_last_ = last > 1 ? border[last - 1] : 0.0;
    solve_tridiagonal(column_);
    inverse_corner_ = 1.0 / (corner - border_product(column_));
  }
  bool solve(const T* r, T* d) const {
    for (int64_t i = 0; i < n_; ++i) work_[i] = static_cast<double>(r[i]);
    solve_tridiagonal(work_);
    const double x = (work_[n_ - 1] - border_product(work_)) * inverse_corner_;
    for (int64_t i = 0; i + 1 < n_; ++i) d[i] = static_cast<T>(work_[i] - column_[i] * x);
    d[n_ - 1] = static_cast<T>(x);
    return all_finite(d, n_);
  }

 private:
  /// v ← M⁻¹ v; leaves the last one alone.
  void solve_tridiagonal(std::vector<double>& v) const {
    for (int64_t i = 0; i + 1 < n_; ++i)
      v[i] = (v[i] - (i > 0 ? lower_[i] * v[i - 1] : 0.0)) * inverse_pivot_[i];
    for (int64_t i = n_ - 3; i >= 0; --i) v[i] -= inverse_pivot_[i] * upper_[i] * v[i + 1];
  }
  double border_product(const std::vector<double>& v) const {
    return n_ == 1 ? 0.0 : border_first_ * v[0] + (n_ > 2 ? border_last_ * v[n_ - 2] : 0.0);
  }

  int64_t n_;
  std::vector<double> lower_, inverse_pivot_, upper_, column_;  // column_: M⁻¹e
  double border_first_, border_last_, inverse_corner_;
  mutable std::vector<double> work_;  // one object a thread
};

/// Sparse LU by Eigen in double.
class DoubleSparseLU {
 public:
  using Vector = Eigen::VectorXd;

  /// The first n rows and columns of the kernel's matrix.
  template <class Kernel>
  DoubleSparseLU(const Kernel& kernel, int64_t n) {
    std::vector<Eigen::Triplet<double>> entries;
    kernel.for_each_entry([&](int64_t i, int64_t j, auto value) {
      if (i < n && j < n)
        entries.emplace_back(static_cast<int>(i), static_cast<int>(j), static_cast<double>(value));
    });
    Eigen::SparseMatrix<double> m(n, n);
    m.setFromTriplets(entries.begin(), entries.end());
    lu_.compute(m);
  }
  bool is_regular() const { return lu_.info() == Eigen::Success; }
  template <class Rhs>
  Vector solve(const Rhs& rhs) const {
    return lu_.solve(rhs);
  }

 private:
  Eigen::SparseLU<Eigen::SparseMatrix<double>> lu_;
};

/// One sparse LU for both channels.
template <class T>
class BurgersFactors<T, 2> {
 public:
  explicit BurgersFactors(const Burgers<T, 2>& kernel)
      : kernel_(kernel), values_(kernel.unknowns()), lu_(kernel, kernel.unknowns() / 2) {}
  bool solve(const T* r, T* d) const {
    if (!lu_.is_regular()) return false;
    kernel_.store(r, T(1), values_.data());
    const auto n = static_cast<int64_t>(values_.size());
    for (int64_t channel = 0; channel < 2; ++channel) {
      const auto view = values_.segment(channel * n / 2, n / 2);
      values_.segment(channel * n / 2, n / 2) = lu_.solve(view.template cast<double>()).template cast<T>();
    }
    kernel_.load(values_.data(), T(1), d);
    return all_finite(values_.data(), n);
  }

 private:
  const Burgers<T, 2>& kernel_;
  mutable Eigen::Matrix<T, Eigen::Dynamic, 1> values_;  // one object a thread
  DoubleSparseLU lu_;
};

/// Sparse LU with the last pressure held at zero and its equation left out, which the others imply.
/// Right-hand side and solution are projected onto mean(p) = 0.
template <class T>
class NavierStokesFactors {
 public:
  explicit NavierStokesFactors(const NavierStokes<T>& kernel)
      : kernel_(kernel), values_(kernel.unknowns()), lu_(kernel, kernel.unknowns() - 1) {}
  bool solve(const T* r, T* d) const {
    if (!lu_.is_regular()) return false;
    const auto n = static_cast<int64_t>(values_.size());
    kernel_.store(r, T(1), values_.data());
    DoubleSparseLU::Vector x = values_.template cast<double>();
    auto pressure = x.tail(n / 3);
    pressure.array() -= pressure.mean();
    x.head(n - 1) = lu_.solve(x.head(n - 1)).eval();
    x[n - 1] = 0.0;
    pressure.array() -= pressure.mean();
    values_ = x.template cast<T>();
    kernel_.load(values_.data(), T(1), d);
    return all_finite(values_.data(), n);
  }

 private:
  const NavierStokes<T>& kernel_;
  mutable Eigen::Matrix<T, Eigen::Dynamic, 1> values_;  // one object a thread
  DoubleSparseLU lu_;
};

template <class T, int Dim>
struct FactorsOf<Burgers<T, Dim>> {
  using Type = BurgersFactors<T, Dim>;
};
template <class T>
struct FactorsOf<NavierStokes<T>> {
  using Type = NavierStokesFactors<T>;
};

}  // namespace prdp::kernels
