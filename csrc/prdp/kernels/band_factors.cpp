#include "prdp/kernels/band_factors.h"

#include <algorithm>
#include <cmath>

namespace prdp::kernels {

std::optional<BandFactors> BandFactors::make(const Entries& entries, int64_t n, double share) {
  constexpr int64_t widest = 16;  // diagonals beside the main one: beyond, an order to look for saves more
  int64_t below[2] = {0, 0}, above[2] = {0, 0};  // as it is, and folded
  for (const auto& e : entries) {
    const int64_t off[2] = {int64_t{e.row()} - e.col(), folded(e.row(), n) - folded(e.col(), n)};
    for (int way = 0; way < 2; ++way) {
      below[way] = std::max(below[way], off[way]);
      above[way] = std::max(above[way], -off[way]);
    }
    if (std::min(below[0] + above[0], below[1] + above[1]) > widest) return std::nullopt;
  }
  const bool folds = below[1] + above[1] < below[0] + above[0];
  BandFactors factors(entries, n, folds, below[folds], above[folds]);
  std::vector<double> sums(n, 0.0);
  for (const auto& e : entries) sums[factors.place(e.col())] += std::abs(e.value());
  if (!factors.factor(share, sums)) return std::nullopt;
  return factors;
}

BandFactors::BandFactors(const Entries& entries, int64_t n, bool folds, int64_t below, int64_t above)
    : n_(n), below_(below), width_(below + above), folds_(folds), pivot_(n) {
  // Row i begins at column i - below, or at the first, and moves to the left as its entries are eliminated.
  upper_.assign(n * (width_ + 1), 0.0);
  lower_.assign(n * below, 0.0);
  for (const auto& e : entries) {
    const int64_t i = place(e.row()), j = place(e.col());
    upper(i)[j - std::max<int64_t>(i - below, 0)] += e.value();
  }
}

bool BandFactors::factor(double share, const std::vector<double>& sums) {
  for (int64_t j = 0; j < n_; ++j) {  // rows j to j + below begin at column j
    int64_t largest = j;
    for (int64_t i = j + 1; i <= j + rows_below(j); ++i)
      if (std::abs(upper(i)[0]) > std::abs(upper(largest)[0])) largest = i;
    pivot_[j] = static_cast<int>(largest);
    if (largest != j) std::swap_ranges(upper(j), upper(j) + width_ + 1, upper(largest));
    const double* const row = upper(j);
    if (!(std::abs(row[0]) > share * sums[j])) return false;
    for (int64_t i = 1; i <= rows_below(j); ++i) {
      double* const other = upper(j + i);
      const double factor = lower_[j * below_ + i - 1] = other[0] / row[0];
      for (int64_t k = 1; k <= width_; ++k) other[k - 1] = other[k] - factor * row[k];
      other[width_] = 0.0;
    }
  }
  return true;
}

}  // namespace prdp::kernels
