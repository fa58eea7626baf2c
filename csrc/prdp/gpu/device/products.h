#pragma once
#include <cmath>
#include <cstdint>

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
struct StencilProducts {
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

/// Of κ of shift·u - ∇·(κ ∇u), (batch or 1, *shape), and of a shift of the same shape.
template <class T>
struct DiffusionProducts {
  PairOfVectors<T> pair;
  int n[3];
  bool periodic[3], zero[6];  // whether u is zero at the low and the high side of an axis
  double per_cell[3];
  bool harmonic;
  const T* kappa;  // (batch or 1, *shape), as many as `out`
  T* out;

  void operator()(int i) const {
    const int point = i % pair.points, s = i / pair.points;
    const int at[3] = {point / (n[2] * n[1]), point / n[2] % n[1], point % n[2]};
    const int strides[3] = {n[2] * n[1], n[2], 1};
    const T* const mine = kappa + static_cast<int64_t>(s) * pair.points;
    T sum = 0;
    for (int side = 0; side < 6; ++side) {
      const int axis = side / 2, next = at[axis] + (side % 2 ? 1 : -1);
      const T scale = static_cast<T>(per_cell[axis] * per_cell[axis]);
      if (next >= 0 && next < n[axis]) sum += through(s, mine, point, point + (next - at[axis]) * strides[axis], scale);
      else if (periodic[axis] && n[axis] > 1)
        sum += through(s, mine, point, point + (next < 0 ? n[axis] - 1 : 1 - n[axis]) * strides[axis], scale);
      else if (zero[side])
        sum += 2 * scale * pair.sum(s, [&](T& all, const T* l, const T* v) { all += v[point] * l[point]; });
    }
    out[i] = sum;
  }

 private:
  T through(int s, const T* of_sample, int here, int there, T scale) const {
    const T coupled = scale * pair.sum(s, [&](T& sum, const T* l, const T* v) {
      sum += (v[there] - v[here]) * (l[there] - l[here]);
    });
    if (!harmonic) return coupled * T(0.5);
    const T part = of_sample[there] / (of_sample[here] + of_sample[there]);
    return coupled * (part == part ? 2 * part * part : T(0));  // 0 where κ is not finite: the sample was refused
  }
};

}  // namespace prdp::gpu
