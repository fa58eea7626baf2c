#pragma once
#include <Eigen/LU>
#include <cstdint>

#include "prdp/kernels/add_product_once.h"
#include "prdp/kernels/vector_loops.h"

namespace prdp::kernels {

namespace {

/// See Loops<T>::factor_lu.
void factor_lu(double* a, int64_t stride, int64_t n, int64_t* rows) {
  Eigen::Map<Eigen::MatrixXd, 0, Eigen::OuterStride<>> matrix(a, n, n, Eigen::OuterStride<>(stride));
  const Eigen::PartialPivLU<Eigen::Ref<Eigen::MatrixXd>> lu(matrix);
  const auto& place = lu.permutationP().indices();
  for (int64_t i = 0; i < n; ++i) rows[place[i]] = i;
}

/// x_k -= Σ a(k, column + r) x_column+r for `Columns` columns and rows [begin, end), of `Count` vectors side by side.
template <int Columns, int Count>
void take_off_columns(const double* a, int64_t stride, int64_t column, int64_t begin, int64_t end, double* x) {
  double of_columns[Columns][Count];
  for (int r = 0; r < Columns; ++r)
    for (int c = 0; c < Count; ++c) of_columns[r][c] = x[(column + r) * Count + c];
  const double* const first = a + column * stride;
  for (int64_t k = begin; k < end; ++k)
    for (int c = 0; c < Count; ++c) {
      double value = x[k * Count + c];
      for (int r = 0; r < Columns; ++r) value = add_product_once(value, -first[r * stride + k], of_columns[r][c]);
      x[k * Count + c] = value;
    }
}

/// x_column+r -= Σ a(k, column + r) x_k over rows [begin, end).
template <int Columns, int Count>
void take_off_rows(const double* a, int64_t stride, int64_t column, int64_t begin, int64_t end, double* x) {
  double sums[Columns][Count] = {};
  const double* const first = a + column * stride;
  for (int64_t k = begin; k < end; ++k)
    for (int r = 0; r < Columns; ++r)
      for (int c = 0; c < Count; ++c)
        sums[r][c] = add_product_once(sums[r][c], first[r * stride + k], x[k * Count + c]);
  for (int r = 0; r < Columns; ++r)
    for (int c = 0; c < Count; ++c) x[(column + r) * Count + c] -= sums[r][c];
}

/// See Loops<T>::solve_lu, for `Count` vectors. Columns are taken in blocks, which read the others' x once.
template <int Count>
void solve_lu(const double* a, int64_t stride, int64_t n, double* x, bool transposed) {
  constexpr int block = 4;
  const auto divide = [&](int64_t j) {
    for (int c = 0; c < Count; ++c) x[j * Count + c] /= a[j * stride + j];
  };
  const auto from_the_end = [&](const auto& body) {
    int64_t j = n;
    for (; j >= block; j -= block) body(j - block, Constant<block>());
    for (; j > 0; --j) body(j - 1, Constant<1>());
  };
  if (!transposed) {
    for_each_block<block>(0, n, [&](int64_t j, auto size) {
      for (int64_t i = j; i < j + size.value; ++i) take_off_columns<1, Count>(a, stride, i, i + 1, j + size.value, x);
      take_off_columns<size.value, Count>(a, stride, j, j + size.value, n, x);
    });
    from_the_end([&](int64_t j, auto size) {
      for (int64_t i = j + size.value - 1; i >= j; --i) {
        divide(i);
        take_off_columns<1, Count>(a, stride, i, j, i, x);
      }
      take_off_columns<size.value, Count>(a, stride, j, 0, j, x);
    });
    return;
  }
  for_each_block<block>(0, n, [&](int64_t j, auto size) {
    take_off_rows<size.value, Count>(a, stride, j, 0, j, x);
    for (int64_t i = j; i < j + size.value; ++i) {
      take_off_rows<1, Count>(a, stride, i, j, i, x);
      divide(i);
    }
  });
  from_the_end([&](int64_t j, auto size) {
    take_off_rows<size.value, Count>(a, stride, j, j + size.value, n, x);
    for (int64_t i = j + size.value - 1; i >= j; --i) take_off_rows<1, Count>(a, stride, i, i + 1, j + size.value, x);
  });
}

}  // namespace

}  // namespace prdp::kernels
