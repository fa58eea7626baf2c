#pragma once
#include <algorithm>
#include <array>
#include <cmath>

#include "prdp/kernels/vector.h"
#include "prdp/solvers/solve_samples.h"

namespace prdp {

/// The factors that a batch shares, for one thread: they solve for its next samples together, and multiply these
/// solutions by A where that pays, too. Whoever asks for one of them finds it made.
template <class T>
class SolvedAhead final : public kernels::Factors<T> {
 public:
  SolvedAhead(const SharedSystem<T>& shared, const SampleBatch<T>& batch, int64_t end)
      : shared_(shared), batch_(batch), end_(end) {
    memory_.prepare(3 * kMost, length(), shared.a->layout().halo);
  }
  static bool pays(const SharedSystem<T>& shared, const SampleBatch<T>& batch, int64_t samples) {
    return samples > 1 && shared.factors && shared.factors->gains_by_several() && !batch.arrays.x0;
  }

  /// The next to be solved is sample s.
  void come_to(int64_t s) {
    if (s >= next_) make_from(s);
  }
  bool solve(const T* r, T* d) const override {
    return find(made_, r, kRightHandSides, kSolutions, d) || shared_.factors->solve(r, d);
  }
  bool has_product(const T* x, T* out) const override { return find(multiplied_, x, kSolutions, kProducts, out); }

 private:
  static constexpr int64_t kMost = 8, kRightHandSides = 0, kSolutions = kMost, kProducts = 2 * kMost;

  int64_t length() const { return shared_.a->length(); }

  /// Copies the vector that goes with v, of the first `count`.
  bool find(int64_t count, const T* v, int64_t among, int64_t goes_with, T* to) const {
    for (int64_t i = 0; i < count; ++i) {
      if (!std::equal(v, v + length(), memory_.vector(among + i))) continue;
      std::copy_n(memory_.vector(goes_with + i), length(), to);
      return true;
    }
    return false;
  }
  std::array<T*, kMost> vectors(int64_t from) const {
    std::array<T*, kMost> v;
    for (int64_t i = 0; i < kMost; ++i) v[i] = memory_.vector(from + i);
    return v;
  }

  /// Loads right-hand sides as solve_sample() does.
  void make_from(int64_t s) {
    const auto& a = *shared_.a;
    made_ = 0;
    for (next_ = s; next_ < end_ && made_ < kMost; ++next_) {
      const T* const b = batch_.arrays.b + next_ * batch_.unknowns;
      const T magnitude = kernels::largest_magnitude(b, batch_.unknowns);
      if (!std::isfinite(magnitude) || magnitude == T(0)) continue;
      T* const r = memory_.vector(kRightHandSides + made_++);
      a.layout().load(b, kernels::power_of_two_scale(magnitude), r);
      if (a.left_null_space()) a.left_null_space()->project(r);
    }
    const auto r = vectors(kRightHandSides), x = vectors(kSolutions), products = vectors(kProducts);
    if (!shared_.factors->solve_several(r.data(), x.data(), made_)) made_ = 0;
    multiplied_ = made_ > 0 && a.apply_to_several(x.data(), products.data(), made_) ? made_ : 0;
  }

  const SharedSystem<T>& shared_;
  const SampleBatch<T>& batch_;
  int64_t end_, next_ = 0;  // the first sample that was not looked at
  int64_t made_ = 0, multiplied_ = 0;  // how many solutions there are, and how many products of these
  mutable kernels::Workspace<T> memory_;
};

}  // namespace prdp
