#pragma once
#include <cstdint>
#include <tuple>

#include "prdp/solvers/space.h"

namespace prdp {

/// Conjugate gradients (Hestenes and Stiefel 1952), for symmetric definite operators of either sign.
template <VectorSpace Space>
class ConjugateGradientMethod {
 public:
  static constexpr bool kHasRecursiveResidual = true;

  explicit ConjugateGradientMethod(Space& space)
      : x(space.vector()), space_(space), r_(space.vector()), p_(space.vector()), q_(space.vector()) {}

  void start() {
    space_.fill_zero(x);
    space_.copy(space_.b(), r_);
    space_.copy(space_.b(), p_);
    rr_ = pp_ = space_.b2();
  }
  void step() {
    const auto [pq, qq] = space_.apply_with_dots(p_, q_);
    alpha_ = space_.step_length(rr_, pq, pp_, qq);
    const auto rr = space_.descend(alpha_, p_, q_, x, r_);
    beta_ = space_.ratio(rr, rr_);
    space_.xpby(r_, beta_, p_);
    pp_ = rr + beta_ * beta_ * pp_;  // r and p are orthogonal
    rr_ = rr;
  }
  auto residual2() const { return rr_; }
  auto recompute_residual() {
    go_on_from(space_.residual(x, r_));
    return rr_;
  }

  /// What the next iteration starts from, beside x; resume() once it has been put back.
  auto carried() { return std::tie(r_, p_, rr_, pp_); }
  void resume(int64_t) {}

  typename Space::Vector x;

 protected:
  /// Starts anew along the true residual, which is in r.
  void go_on_from(const typename Space::Scalar& rr) {
    rr_ = rr;
    space_.copy(r_, p_);
    space_.assign(rr_, pp_);
  }

  Space& space_;
  typename Space::Vector r_, p_, q_;  // residual; search direction; A p
  typename Space::Scalar rr_{}, pp_{}, alpha_{}, beta_{};
};

}  // namespace prdp
