#pragma once
#include <algorithm>
#include <array>
#include <cmath>

#include "prdp/kernels/vector.h"
#include "prdp/solvers/solve_samples.h"

namespace prdp {

/// The factors that a batch shares, for one thread: they solve for its next samples together, and whoever asks for one
/// of these solutions finds it made.
template <class T>
class SolvedAhead final : public kernels::Factors<T> {
 public:
  SolvedAhead(const SharedSystem<T>& shared, const SampleBatch<T>& batch, int64_t end)
      : shared_(shared), batch_(batch), end_(end) {
    memory_.prepare(2 * kMost, length(), shared.a->layout().halo);
  }
  static bool pays(const SharedSystem<T>& shared, const SampleBatch<T>& batch, int64_t samples) {
    return samples > 1 && shared.factors && shared.factors->gains_by_several() && !batch.arrays.x0;
  }

  /// The next to be solved is sample s.
  void come_to(int64_t s) {
    if (s >= next_) make_from(s);
  }
  bool solve(const T* r, T* d) const override {
    for (int64_t i = 0; i < made_; ++i) {
      if (!std::equal(r, r + length(), memory_.vector(i))) continue;
      std::copy_n(memory_.vector(kMost + i), length(), d);
      return true;
    }
    return shared_.factors->solve(r, d);
  }

 private:
  static constexpr int64_t kMost = 8;

  int64_t length() const { return shared_.a->length(); }

  /// Loads right-hand sides as solve_sample() does.
  void make_from(int64_t s) {
    const auto& a = *shared_.a;
    made_ = 0;
    for (next_ = s; next_ < end_ && made_ < kMost; ++next_) {
      const T* const b = batch_.arrays.b + next_ * batch_.unknowns;
      const T magnitude = kernels::largest_magnitude(b, batch_.unknowns);
      if (!std::isfinite(magnitude) || magnitude == T(0)) continue;
      T* const r = memory_.vector(made_++);
      a.layout().load(b, kernels::power_of_two_scale(magnitude), r);
      if (a.left_null_space()) a.left_null_space()->project(r);
    }
    std::array<const T*, kMost> r;
    std::array<T*, kMost> d;
    for (int64_t i = 0; i < made_; ++i) r[i] = memory_.vector(i), d[i] = memory_.vector(kMost + i);
    if (!shared_.factors->solve_several(r.data(), d.data(), made_)) made_ = 0;
  }

  const SharedSystem<T>& shared_;
  const SampleBatch<T>& batch_;
  int64_t end_, next_ = 0, made_ = 0;  // the first sample that was not looked at; how many solutions there are
  mutable kernels::Workspace<T> memory_;
};

}  // namespace prdp
