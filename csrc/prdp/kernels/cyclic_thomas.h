#pragma once
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "prdp/kernels/packed_stencil.h"

namespace prdp::kernels {

/// Thomas' algorithm for all unknowns of a line but the last one, which may be coupled to both ends:
/// [[M, e], [f, c]] with M tridiagonal is solved by x_n = (r_n - f·M⁻¹r)/(c - f·M⁻¹e). There is no
/// pivoting: only a matrix that is diagonally dominant by rows or by columns goes without (Higham, Accuracy
/// and Stability of Numerical Algorithms, 2002, theorem 9.9).
class CyclicThomas {
 public:
  template <class T>
  explicit CyclicThomas(const PackedStencil<T>& a)
      : n_(a.grid().shape[2]), lower_(n_), inverse_pivot_(n_), upper_(n_), column_(n_) {
    const int64_t last = n_ - 1;
    double corner = 0;
    std::vector<double> pivot(n_), border(n_);
    // Where n is 2 or 3, entries coincide and add up.
    a.for_each_entry([&](int64_t i, int64_t j, double value) {
      double& entry = i == last   ? (j == last ? corner : border[j])
                      : j == last ? column_[i]
                      : j < i     ? lower_[i]
                      : j > i     ? upper_[i]
                                  : pivot[i];
      entry += value;
    });
    is_dominant_ = is_dominant(pivot, border, corner, 8.0 * std::numeric_limits<T>::epsilon());
    if (!is_dominant_) return;
    for (int64_t i = 0; i < last; ++i) {
      if (i > 0) pivot[i] -= lower_[i] * inverse_pivot_[i - 1] * upper_[i - 1];
      inverse_pivot_[i] = 1.0 / pivot[i];
    }
    border_first_ = last > 0 ? border[0] : 0.0;
    border_last_ = last > 1 ? border[last - 1] : 0.0;
    solve_tridiagonal(column_.data());
    const double taken_off = border_product(column_.data()), last_pivot = corner - taken_off;
    inverse_corner_ = 1.0 / last_pivot;
    is_regular_ = std::abs(last_pivot) > std::numeric_limits<double>::epsilon() * static_cast<double>(n_) *
                                             (std::abs(corner) + std::abs(taken_off));
  }
  bool is_dominant() const { return is_dominant_; }
  /// Whether the last pivot, the only one that a dominant matrix may lose, is larger than its rounding errors.
  bool is_regular() const { return is_regular_; }
  /// v ← A⁻¹ v
  void solve(double* v) const {
    solve_tridiagonal(v);
    const double x = (v[n_ - 1] - border_product(v)) * inverse_corner_;
    for (int64_t i = 0; i + 1 < n_; ++i) v[i] -= column_[i] * x;
    v[n_ - 1] = x;
  }

 private:
  /// Whether what lies beside the diagonal weighs no more than it in any row, or in any column; `slack` is
  /// what rounding may hide.
  bool is_dominant(const std::vector<double>& pivot, const std::vector<double>& border, double corner,
                   double slack) const {
    const int64_t last = n_ - 1;
    double last_row = 0, last_column = 0;
    bool by_rows = true, by_columns = true;
    for (int64_t i = 0; i < last; ++i) {
      const double bound = std::abs(pivot[i]) * (1.0 + slack), above = i > 0 ? upper_[i - 1] : 0.0;
      by_rows = by_rows && std::abs(lower_[i]) + std::abs(upper_[i]) + std::abs(column_[i]) <= bound;
      by_columns = by_columns && std::abs(above) + std::abs(lower_[i + 1]) + std::abs(border[i]) <= bound;
      last_row += std::abs(border[i]);
      last_column += std::abs(column_[i]);
    }
    const double bound = std::abs(corner) * (1.0 + slack);
    return (by_rows && last_row <= bound) || (by_columns && last_column <= bound);
  }

  /// v ← M⁻¹ v; leaves the last one alone.
  void solve_tridiagonal(double* v) const {
    for (int64_t i = 0; i + 1 < n_; ++i) v[i] = (v[i] - (i > 0 ? lower_[i] * v[i - 1] : 0.0)) * inverse_pivot_[i];
    for (int64_t i = n_ - 3; i >= 0; --i) v[i] -= inverse_pivot_[i] * upper_[i] * v[i + 1];
  }
  double border_product(const double* v) const {
    return n_ == 1 ? 0.0 : border_first_ * v[0] + (n_ > 2 ? border_last_ * v[n_ - 2] : 0.0);
  }

  int64_t n_;
  bool is_dominant_, is_regular_ = false;
  std::vector<double> lower_, inverse_pivot_, upper_, column_;  // column_: M⁻¹e
  double border_first_, border_last_, inverse_corner_;
};

}  // namespace prdp::kernels
