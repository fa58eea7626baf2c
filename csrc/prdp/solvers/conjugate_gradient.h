#pragma once
#include <cstdint>
#include <tuple>

#include "prdp/solvers/space.h"

namespace prdp {

/// Conjugate gradients (Hestenes and Stiefel 1952), for symmetric definite operators of either sign. Preconditioned,
/// z = M⁻¹ r takes the place of r in the directions: α = r·z / p·Ap; u += α p; r -= α A p; p ← z + β p. M must be
/// definite too, of either sign; the residual that the method is judged by is r itself.
template <VectorSpace Space>
class ConjugateGradientMethod {
 public:
  using Scalar = typename Space::Scalar;
  static constexpr bool kHasRecursiveResidual = true, kDescendsEnergy = true;

  explicit ConjugateGradientMethod(Space& space)
      : x(space.vector()),
        space_(space),
        r_(space.vector()),
        p_(space.vector()),
        q_(space.vector()),
        z_(space.is_preconditioned() ? space.vector() : r_) {}

  void start() {
    space_.fill_zero(x);
    space_.copy(space_.b(), r_);
    begin_along(space_.b2());
  }
  void step() {
    if (space_.is_preconditioned()) space_.break_down_unless_positive(rz_, rr_);  // r·M⁻¹ r has changed its sign
    const auto [pq, qq] = space_.apply_along(p_, p_, q_);
    alpha_ = space_.guarded_quotient(rz_, pq, pp_, qq);  // 0 where r·z has changed its sign
    if (!space_.is_preconditioned()) {
      const auto rr = space_.update_iterate_and_residual(alpha_, p_, q_, x, r_);
      beta_ = space_.ratio(rr, rz_);
      space_.xpby(r_, beta_, p_);
      pp_ = space_.sum_of_squares(rr, beta_, pp_);
      rr_ = rz_ = rr;
      return;
    }
    rr_ = space_.update_iterate_and_residual(alpha_ * sign_, p_, q_, x, r_);
    const Scalar rz = sign_ * space_.precondition(r_, z_);
    beta_ = space_.ratio(rz, rz_);
    pp_ = space_.xpby_with_square(z_, beta_, p_);
    rz_ = rz;
  }
  auto residual2() const { return rr_; }
  auto recompute_residual() {
    begin_along(space_.residual(x, r_));
    return rr_;
  }

  /// The true one, after recompute_residual().
  const typename Space::Vector& residual() const { return r_; }

  /// What the next iteration starts from, beside x; resume() once it has been put back.
  auto iteration_state() { return std::tie(r_, p_, rr_, rz_, pp_, sign_); }
  void resume(int64_t) {}

  typename Space::Vector x;

 private:
  /// Starts anew along the residual, which is in r and whose square is given.
  void begin_along(const Scalar& rr) {
    space_.assign(rr, rr_);
    space_.assign(rr * 0 + 1, sign_);
    if (!space_.is_preconditioned()) {
      space_.copy(r_, p_);
      space_.assign(rr_, rz_);
      space_.assign(rr_, pp_);
      return;
    }
    const Scalar rz = space_.precondition(r_, z_), negative = space_.is_larger(-rz, rz * 0);
    space_.assign(1 - 2 * negative, sign_);
    space_.assign(sign_ * rz, rz_);
    space_.copy(z_, p_);
    space_.assign(space_.dot(z_, z_), pp_);
  }

  Space& space_;
  typename Space::Vector r_, p_, q_, z_;  // residual; search direction; A p; M⁻¹ r, or r itself
  Scalar rr_{}, rz_{}, pp_{};             // r·r, sign_·r·z, p·p
  Scalar sign_{};                         // of r·z where the directions began
  Scalar alpha_{}, beta_{};
};

}  // namespace prdp
