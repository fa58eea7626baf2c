#pragma once
#include "prdp/kernels/galerkin_point.h"
#include "prdp/kernels/vector_loops.h"

/// The part of loops.cpp for transfers between grids and for coarse operators; included there only, and for the same
/// reason all of internal linkage.
namespace prdp::kernels {

namespace {

template <class T>
void restrict_row(const T* middle, const T* before, const T* weight_before, const T* after, const T* weight_after,
                  T* __restrict out, int64_t n) {
  for (int64_t i = 0; i < n; ++i) out[i] = middle[i] + weight_before[i] * before[i] + weight_after[i] * after[i];
}

template <class T>
void add_interpolated(const T* before, const T* weight_before, const T* after, const T* weight_after, T* __restrict out,
                      int64_t n) {
  for (int64_t i = 0; i < n; ++i) out[i] += weight_before[i] * before[i] + weight_after[i] * after[i];
}

template <class T>
void split(const T* row, T* __restrict first, T* __restrict second, int64_t n) {
  for (int64_t i = 0; i < n / 2; ++i) {
    first[i] = row[2 * i];
    second[i] = row[2 * i + 1];
  }
  if (n % 2 != 0) first[n / 2] = row[n - 1];
}

template <class T>
void add_merged(const T* first, const T* second, T* __restrict row, int64_t n) {
  for (int64_t i = 0; i < n / 2; ++i) {
    row[2 * i] += first[i];
    row[2 * i + 1] += second[i];
  }
  if (n % 2 != 0) row[n - 1] += first[n / 2];
}

/// Galerkin products with the same offset in the other axes, for points that lie `Step` apart.
template <int Step, bool Sides, class T>
void galerkin_points(const GalerkinProduct<T>& c, int64_t n) {
  for (int64_t i = 0; i < n; ++i) {
    const int64_t f = Step * i;
    GalerkinPoint<T> point;
    point.restrict_before = c.restrict_before[f];
    point.restrict_after = c.restrict_after[f];
    point.before_left = c.before_left[f];
    point.before_right = c.before_right[f];
    point.after_left = c.after_left[f];
    point.after_right = c.after_right[f];
    point.take_centres(c.centre_before[f], c.centre_here[f], c.centre_after[f]);
    if constexpr (Sides)
      point.take_sides({c.lower_before[f], c.lower_here[f], c.lower_after[f]},
                       {c.upper_before[f], c.upper_here[f], c.upper_after[f]});
    c.left[i] = point.left;
    c.centre[i] = point.centre;
    c.right[i] = point.right;
  }
}

template <class T>
void galerkin_product(const GalerkinProduct<T>& c, int64_t step, int64_t n) {
  const bool sides = c.lower_here != nullptr;
  if (step == 1) return sides ? galerkin_points<1, true>(c, n) : galerkin_points<1, false>(c, n);
  sides ? galerkin_points<2, true>(c, n) : galerkin_points<2, false>(c, n);
}

}  // namespace

}  // namespace prdp::kernels
