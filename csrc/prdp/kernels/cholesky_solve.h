#pragma once
#include <Eigen/SparseCholesky>
#include <cstdint>

#include "prdp/kernels/add_product_once.h"

namespace prdp::kernels {

/// x ← L⁻ᵀ L⁻¹ x for `Count` columns, whose entries lie side by side: L is read once for all of them, and each has the
/// bits that it has alone.
template <int Count>
void solve_cholesky(const Eigen::SparseMatrix<double>& lower, double* x) {
  const auto* const begin = lower.outerIndexPtr();
  const auto* const row = lower.innerIndexPtr();
  const double* const value = lower.valuePtr();  // the diagonal comes first in each column
  for (int64_t j = 0; j < lower.cols(); ++j) {
    double of_j[Count];
    for (int c = 0; c < Count; ++c) x[j * Count + c] = of_j[c] = x[j * Count + c] / value[begin[j]];
    for (int64_t k = begin[j] + 1; k < begin[j + 1]; ++k) {
      double* const to = x + int64_t{row[k]} * Count;
      for (int c = 0; c < Count; ++c) to[c] = add_product_once(to[c], -value[k], of_j[c]);
    }
  }
  for (int64_t j = lower.cols() - 1; j >= 0; --j) {
    double sum[Count];
    for (int c = 0; c < Count; ++c) sum[c] = x[j * Count + c];
    for (int64_t k = begin[j] + 1; k < begin[j + 1]; ++k) {
      const double* const from = x + int64_t{row[k]} * Count;
      for (int c = 0; c < Count; ++c) sum[c] = add_product_once(sum[c], -value[k], from[c]);
    }
    for (int c = 0; c < Count; ++c) x[j * Count + c] = sum[c] / value[begin[j]];
  }
}

}  // namespace prdp::kernels
