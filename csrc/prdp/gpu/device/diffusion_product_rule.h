#pragma once
#include "prdp/gpu/device/broadcast_sum.h"
#include "prdp/gpu/device/diffusion.h"
#include "prdp/gpu/device/product_rules.h"

/// ∂⟨λ, A u⟩ for what shift·u - ∇·(κ ∇u) is made of, as in diffusion.h.
namespace prdp::gpu {

/// h of a Robin side: a field of the side, or one number.
template <class T>
struct SideField {
  const T* values;  // null: the number
  int64_t sample;   // the step between samples; 0: they share it
  int step;         // between points; 0: they share it
  T number;

  T at(int s, int on_side) const { return values ? values[s * sample + on_side * step] : number; }
};

/// Of κ, (batch or 1, kappas, *shape), then of the shift and of h of each Robin side, in one loop. Axes are z, y and x;
/// κ is that of all, or of each of the last `kappas`.
template <class T>
struct DiffusionProductRule {
  static constexpr int kSums = 7;
  PairOfVectors<T> pair;  // for the sets of κ
  int batch, kappas, n[3], sides[6];
  double inverse_width[3];
  bool harmonic;
  const T* kappa;
  T* kappa_out;
  SideField<T> robin[6];
  BroadcastSum sums[kSums];  // the shift's, and each side's; of a side, the axis across it has one point
  double* sums_out[kSums];

  void operator()(int i) const {
    const int entries = batch / pair.samples * kappas * pair.points, row = i / pair.points;
    if (i < entries) {
      kappa_out[i] = kappa_bar(row / kappas, row % kappas, i % pair.points);
      return;
    }
    i -= entries;
    for (int k = 0; k < kSums; ++k) {
      if (i >= 0 && i < sums[k].count) sums_out[k][i] = k == 0 ? shift_bar(i) : robin_bar(k - 1, i);
      i -= sums[k].count;
    }
  }

 private:
  T scale(int axis) const { return static_cast<T>(inverse_width[axis] * inverse_width[axis]); }
  T product(int s, int channel, int point) const {
    const int64_t k = (static_cast<int64_t>(s) * pair.channels + channel) * pair.points + point;
    return pair.lambda[k] * pair.u[k];
  }
  /// Which κ is that of an axis.
  int kappa_of(int axis) const { return kappas == 1 ? 0 : axis + kappas - 3; }
  T kappa_at(int s, int axis, int point) const {
    return kappa[(static_cast<int64_t>(s / pair.samples) * kappas + kappa_of(axis)) * pair.points + point];
  }

  T kappa_bar(int set, int which, int point) const {
    const int at[3] = {point / (n[2] * n[1]), point / n[2] % n[1], point % n[2]};
    const int strides[3] = {n[2] * n[1], n[2], 1};
    T sum = 0;
    for (int side = 0; side < 6; ++side) {
      const int axis = side / 2, next = at[axis] + (side % 2 ? 1 : -1);
      if (kappa_of(axis) != which) continue;
      if (next >= 0 && next < n[axis]) sum += through(set, point, point + (next - at[axis]) * strides[axis], axis);
      else if (sides[side] == kPeriodicSide && n[axis] > 1)
        sum += through(set, point, point + (next < 0 ? n[axis] - 1 : 1 - n[axis]) * strides[axis], axis);
      else if (sides[side] == kZeroSide)
        sum += 2 * scale(axis) * pair.sum(set, [&](T& all, const T* l, const T* v) { all += v[point] * l[point]; });
      else if (sides[side] == kRobinSide) sum += 2 * scale(axis) * on_robin(set, side, at, point);
    }
    return sum;
  }
  T through(int set, int here, int there, int axis) const {
    const T coupled = scale(axis) * pair.sum(set, [&](T& sum, const T* l, const T* v) {
      sum += (v[there] - v[here]) * (l[there] - l[here]);
    });
    if (!harmonic) return coupled * T(0.5);
    const int s = set * pair.samples;
    const T part = kappa_at(s, axis, there) / (kappa_at(s, axis, here) + kappa_at(s, axis, there));
    return coupled * (part == part ? 2 * part * part : T(0));  // 0 where κ is not finite: the sample was refused
  }
  T on_robin(int set, int side, const int (&at)[3], int point) const {
    T sum = 0;
    for (int s = set * pair.samples; s < (set + 1) * pair.samples; ++s) {
      T of_sample = 0;
      for (int c = 0; c < pair.channels; ++c) of_sample += product(s, c, point);
      sum += of_sample * squared_share(s, side, at, point, /*of_side=*/true);
    }
    return sum;
  }
  /// Of within·beyond/(within + beyond), with within = 2κ/h² and beyond = h of the side over the width of a cell: the
  /// share of one of them in their sum, squared, which is the derivative for the other one.
  T squared_share(int s, int side, const int (&at)[3], int point, bool of_side) const {
    const int axis = side / 2;
    const int on_side = axis == 0 ? at[1] * n[2] + at[2] : axis == 1 ? at[0] * n[2] + at[2] : at[0] * n[1] + at[1];
    const T within = 2 * scale(axis) * kappa_at(s, axis, point);
    const T beyond = static_cast<T>(inverse_width[axis]) * robin[side].at(s, on_side);
    const T part = 1 / (1 + (of_side ? within / beyond : beyond / within));  // h may be infinite
    return part == part ? part * part : T(0);
  }

  double shift_bar(int i) const {
    return sums[0].sum(i, [&](const int (&at)[BroadcastSum::kAxes]) {
      return product(at[0], at[1], (at[2] * n[1] + at[3]) * n[2] + at[4]);
    });
  }
  double robin_bar(int side, int i) const {
    const int axis = side / 2;
    return sums[1 + side].sum(i, [&](const int (&at)[BroadcastSum::kAxes]) {
      int place[3] = {at[2], at[3], at[4]};
      place[axis] = side % 2 ? n[axis] - 1 : 0;
      const int point = (place[0] * n[1] + place[1]) * n[2] + place[2];
      return static_cast<T>(inverse_width[axis]) * product(at[0], at[1], point) *
             squared_share(at[0], side, place, point, /*of_side=*/false);
    });
  }
};

}  // namespace prdp::gpu
