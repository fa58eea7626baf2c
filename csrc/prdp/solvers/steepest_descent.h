#pragma once
#include <cstdint>
#include <tuple>

#include "prdp/solvers/space.h"

namespace prdp {

/// α = r·r / r·Ar; u += α r; r -= α A r. Fits definite operators of either sign.
template <VectorSpace Space>
class SteepestDescentMethod {
 public:
  static constexpr bool kHasRecursiveResidual = true, kDescendsEnergy = true;

  explicit SteepestDescentMethod(Space& space)
      : x(space.vector()), space_(space), r_(space.vector()), q_(space.vector()) {}

  void start() {
    space_.fill_zero(x);
    space_.copy(space_.b(), r_);
    rr_ = space_.b2();
  }
  void step() {
    const auto [rq, qq] = space_.apply_along(r_, r_, q_);
    alpha_ = space_.guarded_quotient(rr_, rq, rr_, qq);
    rr_ = space_.update_iterate_and_residual(alpha_, r_, q_, x, r_);
  }
  auto residual2() const { return rr_; }
  auto recompute_residual() {
    go_on_from(space_.residual(x, r_));
    return rr_;
  }

  /// The true one, after recompute_residual().
  const typename Space::Vector& residual() const { return r_; }

  /// What the next iteration starts from, beside x; resume() once it has been put back.
  auto iteration_state() { return std::tie(r_, rr_); }
  void resume(int64_t) {}

  typename Space::Vector x;

 protected:
  /// From the true residual, which is in r.
  void go_on_from(const typename Space::Scalar& rr) { rr_ = rr; }

  Space& space_;
  typename Space::Vector r_, q_;  // residual; A r
  typename Space::Scalar rr_{}, alpha_{};
};

}  // namespace prdp
