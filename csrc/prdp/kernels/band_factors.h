#pragma once
#include <Eigen/Sparse>
#include <cstdint>
#include <optional>
#include <vector>

#include "prdp/kernels/add_product_once.h"

namespace prdp::kernels {

/// LU with partial pivoting of a matrix whose entries lie near the diagonal, as those of one dimension do: there is no
/// order to look for. A periodic one is folded first, so that its ends are neighbours: 0, n - 1, 1, n - 2, …
class BandFactors {
 public:
  using Entries = std::vector<Eigen::Triplet<double>>;

  /// Of a matrix of n rows, the sum of these entries. Nothing if its band is wide, or if a pivot is not larger than
  /// this share of the sum of its column's magnitudes.
  static std::optional<BandFactors> make(const Entries& entries, int64_t n, double share);

  /// The place of an unknown, or of an equation, in x.
  int64_t place(int64_t i) const { return folds_ ? folded(i, n_) : i; }
  /// Entries that x must have for each of its columns, zeros behind the first n.
  int64_t length() const { return n_ + width_; }
  /// x ← A⁻¹ x, or A⁻ᵀ x, for `Count` columns, whose entries lie side by side: each has the bits that it has alone.
  template <int Count>
  void solve(double* x, bool transposed) const {
    if (transposed) solve_transposed<Count>(x);
    else solve_given<Count>(x);
  }
  int64_t bytes() const {
    return static_cast<int64_t>((upper_.size() + lower_.size()) * sizeof(double) + pivot_.size() * sizeof(int));
  }

 private:
  BandFactors(const Entries& entries, int64_t n, bool folds, int64_t below, int64_t above);
  static int64_t folded(int64_t i, int64_t n) { return 2 * i < n ? 2 * i : 2 * (n - 1 - i) + 1; }
  bool factor(double share, const std::vector<double>& sums);

  /// Row j of U: its entries from the diagonal on.
  double* upper(int64_t j) { return upper_.data() + j * (width_ + 1); }
  const double* upper(int64_t j) const { return upper_.data() + j * (width_ + 1); }
  /// What rows j + 1, j + 2, … lost of row j.
  const double* lower(int64_t j) const { return lower_.data() + j * below_; }
  int64_t rows_below(int64_t j) const { return std::min(below_, n_ - 1 - j); }

  template <int Count>
  static void take_off(double factor, const double* of, double* from) {
    for (int c = 0; c < Count; ++c) from[c] = add_product_once(from[c], -factor, of[c]);
  }
  template <int Count>
  void swap_rows(double* x, int64_t j) const {
    if (pivot_[j] != j)
      for (int c = 0; c < Count; ++c) std::swap(x[j * Count + c], x[pivot_[j] * Count + c]);
  }
  template <int Count>
  void solve_given(double* x) const {
    for (int64_t j = 0; j < n_; ++j) {
      swap_rows<Count>(x, j);
      for (int64_t i = 1; i <= rows_below(j); ++i) take_off<Count>(lower(j)[i - 1], x + j * Count, x + (j + i) * Count);
    }
    for (int64_t j = n_ - 1; j >= 0; --j) {
      for (int64_t i = 1; i <= width_; ++i) take_off<Count>(upper(j)[i], x + (j + i) * Count, x + j * Count);
      for (int c = 0; c < Count; ++c) x[j * Count + c] /= upper(j)[0];
    }
  }
  template <int Count>
  void solve_transposed(double* x) const {
    for (int64_t j = 0; j < n_; ++j) {
      for (int c = 0; c < Count; ++c) x[j * Count + c] /= upper(j)[0];
      const int64_t most = std::min(width_, n_ - 1 - j);
      for (int64_t i = 1; i <= most; ++i) take_off<Count>(upper(j)[i], x + j * Count, x + (j + i) * Count);
    }
    for (int64_t j = n_ - 1; j >= 0; --j) {
      for (int64_t i = 1; i <= rows_below(j); ++i) take_off<Count>(lower(j)[i - 1], x + (j + i) * Count, x + j * Count);
      swap_rows<Count>(x, j);
    }
  }

  int64_t n_, below_, width_;  // diagonals below the main one; above it, with what pivoting adds
  bool folds_;
  std::vector<double> upper_, lower_;
  std::vector<int> pivot_;  // the row that took the place of row j
};

}  // namespace prdp::kernels
