#pragma once
#include <cmath>
#include <cstdint>

#include "prdp/gpu/device/broadcast_sum.h"

/// ∂⟨λ, A(g) u⟩/∂g for the fields that operators are made of: each entry sums over the channels, and over the samples
/// that share it, in their order.
namespace prdp::gpu {

/// λ and u, (batch, channels, *shape).
template <class T>
struct PairOfVectors {
  const T *lambda, *u;
  int channels, points;
  int samples;  // that share a field

  /// Σ f(λ, u) over the fields of an entry of the s-th set of fields.
  template <class F>
  T sum(int s, const F& f) const {
    T all = 0;
    const int64_t fields = static_cast<int64_t>(samples) * channels;
    for (int64_t k = 0; k < fields; ++k) {
      const int64_t begin = (s * fields + k) * points;
      f(all, lambda + begin, u + begin);
    }
    return all;
  }
};

/// Of the coefficients of a stencil, (batch or 1, count, *shape).
template <class T>
struct StencilProductRule {
  static constexpr int kMost = 125;
  PairOfVectors<T> pair;
  int n[3];
  bool periodic[3];
  int count;
  signed char offsets[kMost][3];
  T* out;

  void operator()(int i) const {
    const int point = i % pair.points, k = i / pair.points % count, s = i / (pair.points * count);
    int at[3] = {point / (n[2] * n[1]), point / n[2] % n[1], point % n[2]};
    bool inside = true;
    for (int a = 0; a < 3; ++a) {
      at[a] += offsets[k][a];
      if (periodic[a]) at[a] = (at[a] % n[a] + n[a]) % n[a];
      inside = inside && at[a] >= 0 && at[a] < n[a];
    }
    const int there = (at[0] * n[1] + at[1]) * n[2] + at[2];
    out[i] = inside ? pair.sum(s, [&](T& sum, const T* l, const T* v) { sum += l[point] * v[there]; }) : T(0);
  }
};

/// Of a number that the Laplacian of a box is multiplied by, as in views.h: Σ λ L u.
template <class T>
struct LaplacianProductRule {
  PairOfVectors<T> pair;
  int n[3];
  double inverse_width2[3];
  BroadcastSum shared;
  double* out;

  void operator()(int i) const {
    out[i] = shared.sum(i, [&](const int (&at)[BroadcastSum::kAxes]) {
      const int strides[3] = {n[2] * n[1], n[2], 1};
      const int64_t here =
          (static_cast<int64_t>(at[0]) * n[0] + at[2]) * strides[0] + static_cast<int64_t>(at[3]) * n[2] + at[4];
      T sum = 0;
      for (int a = 0; a < 3; ++a) {
        const T low = at[2 + a] > 0 ? pair.u[here - strides[a]] : T(0);
        const T high = at[2 + a] + 1 < n[a] ? pair.u[here + strides[a]] : T(0);
        sum += static_cast<T>(inverse_width2[a]) * ((low - pair.u[here]) + (high - pair.u[here]));
      }
      return pair.lambda[here] * sum;
    });
  }
};

/// Of the values of matrices by compressed rows, (batch or 1, stored). λ and u have one channel of as many points as a
/// matrix has rows. 0 where the pattern is none: such a matrix was refused.
template <class T>
struct CsrProductRule {
  PairOfVectors<T> pair;
  int stored;
  const int64_t *crow, *col;
  int64_t crow_step, col_step;  // between matrices; 0: they share it
  T* out;

  void operator()(int i) const {
    const int s = i / stored, k = i % stored, n = pair.points;
    const int64_t* const ends = crow + s * crow_step + 1;
    int row = 0, beyond = n;  // the first row that ends after k
    while (row < beyond) {
      const int middle = row + (beyond - row) / 2;
      if (ends[middle] > k) beyond = middle;
      else row = middle + 1;
    }
    const int64_t column = col[s * col_step + k];
    const bool inside = row < n && column >= 0 && column < n;
    out[i] = inside ? pair.sum(s, [&](T& sum, const T* l, const T* v) { sum += l[row] * v[column]; }) : T(0);
  }
};

}  // namespace prdp::gpu
