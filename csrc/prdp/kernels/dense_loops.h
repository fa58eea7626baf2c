#pragma once
#include "prdp/kernels/vector_loops.h"

/// The part of loops.cpp for products with dense matrices; included there only.
namespace prdp::kernels {

namespace {

/// Rows of `Columns` registers of out = a b.
template <int Rows, int Columns, class T>
void multiply_tile(const DenseProduct<T>& p, int64_t row, int64_t column) {
  const T* a = p.a + row * p.inner;
  const T* b = p.b + column;
  Register<T> sums[Rows][Columns] = {};
  for (int64_t k = 0; k < p.inner; ++k, b += p.columns)
    for (int c = 0; c < Columns; ++c) {
      const auto of_b = load(b + c * kWidth<T>);
      for (int r = 0; r < Rows; ++r) sums[r][c] += a[r * p.inner + k] * of_b;
    }
  for (int r = 0; r < Rows; ++r)
    for (int c = 0; c < Columns; ++c) store(p.out + (row + r) * p.columns + column + c * kWidth<T>, sums[r][c]);
}

template <int Columns, class T>
void multiply_columns(const DenseProduct<T>& p, int64_t column) {
  constexpr int most = kRegisterBytes == 64 ? 12 : 6;  // as many as leave registers for b and an entry of a
  for_each_block<most>(0, p.rows, [&](int64_t row, auto size) { multiply_tile<size.value, Columns>(p, row, column); });
}

template <class T>
void multiply(const DenseProduct<T>& p) {
  const int64_t n = p.columns;
  int64_t column = 0;
  for (; column + 2 * kWidth<T> <= n; column += 2 * kWidth<T>) multiply_columns<2>(p, column);
  for (; column + kWidth<T> <= n; column += kWidth<T>) multiply_columns<1>(p, column);
  if (column == n) return;
  if (n >= kWidth<T>) return multiply_columns<1>(p, n - kWidth<T>);  // some of them a second time
  for (int64_t r = 0; r < p.rows; ++r)
    for (int64_t c = 0; c < n; ++c) {
      T sum = 0;
      for (int64_t k = 0; k < p.inner; ++k) sum += p.a[r * p.inner + k] * p.b[k * n + c];
      p.out[r * n + c] = sum;
    }
}

/// See Loops<T>::add_rows, for the first Rows of them.
template <int Rows, class T>
void add_block_of_rows(const T* weights, const T* rows, int64_t stride, T* __restrict out, int64_t n) {
  for (int64_t j = 0; j < n; ++j) {
    T sum = out[j];
    for (int r = 0; r < Rows; ++r) sum += weights[r] * rows[r * stride + j];
    out[j] = sum;
  }
}

template <class T>
void add_rows(const T* weights, const T* rows, int64_t stride, int64_t count, T* out, int64_t n) {
  for_each_block<8>(0, count, [&](int64_t i, auto size) {
    add_block_of_rows<size.value>(weights + i, rows + i * stride, stride, out, n);
  });
}

}  // namespace

}  // namespace prdp::kernels
