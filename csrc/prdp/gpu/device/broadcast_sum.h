#pragma once
#include <cstdint>

/// Sums over what samples, channels and points share.
namespace prdp::gpu {

/// Sums an array (batch, channels, z, y, x) over the axes along which a tensor is broadcast. A long sum is left in
/// `parts` partial sums, whose order depends on the sizes alone.
struct BroadcastSum {
  static constexpr int kAxes = 5;
  int n[kAxes];
  bool own[kAxes];
  int parts;  // of each sum
  int count;  // of all: entries times parts; 0: there is no such tensor

  /// The part i of all, f(at) summed over it.
  template <class F>
  double sum(int i, const F& f) const {
    int at[kAxes] = {}, entry = i / parts, terms = 1;
    for (int a = kAxes - 1; a >= 0; --a) {
      if (own[a]) {
        at[a] = entry % n[a];
        entry /= n[a];
      } else {
        terms *= n[a];
      }
    }
    double all = 0;
    for (int k = i % parts; k < terms; k += parts) {
      int rest = k;
      for (int a = kAxes - 1; a >= 0; --a) {
        if (own[a]) continue;
        at[a] = rest % n[a];
        rest /= n[a];
      }
      all += static_cast<double>(f(at));
    }
    return all;
  }
};

}  // namespace prdp::gpu
