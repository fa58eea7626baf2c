#pragma once
#include <array>
#include <cmath>
#include <cstdint>
#include <tuple>

#include "prdp/solvers/space.h"

namespace prdp {

/// BiCGStab (van der Vorst 1992), for any operator: two products per iteration and no basis to keep. With r̂, the
/// first residual: ρ = r̂·r, p ← r + β (p - ω v) with β = (ρ/ρ₋)(α/ω), v = A p, α = ρ / r̂·v, s = r - α v, t = A s,
/// ω = s·t / t·t, x += α p + ω s, r = s - ω t. Preconditioned from the right: A M⁻¹ takes the place of A, and x moves
/// along M⁻¹ p and M⁻¹ s.
///
/// It starts anew from r̂ = p = r where r is all but orthogonal to r̂, so that at most two digits of ρ are left. Where
/// r̂·v is rounding, it leaves out the step along p, takes the one along s, and then starts anew.
/// It breaks down where r·A r is rounding: as r̂·v of a start, or as s·t of the iteration before.
template <VectorSpace Space>
class BiCGStabMethod {
 public:
  using Scalar = typename Space::Scalar;
  static constexpr bool kHasRecursiveResidual = true;

  explicit BiCGStabMethod(Space& space)
      : x(space.vector()),
        space_(space),
        r_(space.vector()),
        hat_(space.vector()),
        p_(space.vector()),
        v_(space.vector()),
        t_(space.vector()),
        z_(space.is_preconditioned() ? space.vector() : t_) {}

  void start() {
    for (auto* vector : {&x, &p_, &v_}) space_.fill_zero(*vector);
    space_.copy(space_.b(), r_);
    space_.copy(space_.b(), hat_);
    r2_ = hat2_ = s2_ = st_ = t2_ = space_.b2();
    inverse_hv_ = zero_ = r2_ * 0;
  }
  void step() {
    Scalar rho = rho_or_anew();
    const Scalar over_omega = space_.guarded_quotient(t2_, st_, s2_, t2_);
    space_.xpby(v_, -over_omega, p_);
    space_.xpby(r_, -(rho * inverse_hv_), p_);
    auto [hv, v2] = space_.apply_along(preconditioned(p_), hat_, v_);
    const Scalar starts_anew = space_.breaks_down(hv, hat2_, v2, inverse_hv_);
    space_.restore(starts_anew, zero_, rho);
    space_.restore(starts_anew, zero_, hat2_);
    space_.restore(starts_anew, v2, hv);  // a number to divide by, which ρ = 0 takes out again
    // r·r, which is never zero while there is something to do, is the size that a quotient is judged by; ρ may be zero.
    inverse_hv_ = space_.ratio(space_.guarded_quotient(r2_, hv, hat2_, v2), r2_);
    const auto moves = [&](const Scalar& length) { return space_.unless_zero(length, over_omega, inverse_hv_); };
    s2_ = space_.update_iterate_and_residual(moves(rho * inverse_hv_), space_.is_preconditioned() ? z_ : p_, v_, x, r_);
    const auto [st, t2] = apply_to(r_, t_);
    st_ = st;
    t2_ = t2;
    r2_ = space_.update_iterate_and_residual(moves(space_.ratio(st, t2)), space_.is_preconditioned() ? z_ : r_, t_, x,
                                             r_);
    start_anew_where(starts_anew);
  }
  auto residual2() const { return r2_; }
  /// From the true residual it starts anew.
  auto recompute_residual() {
    r2_ = space_.residual(x, r_);
    space_.copy(r_, hat_);
    for (auto* square : {&hat2_, &s2_, &st_, &t2_}) space_.assign(r2_, *square);
    space_.assign(r2_ * 0, inverse_hv_);
    return r2_;
  }

  /// What the next iteration starts from, beside x; resume() once it has been put back.
  auto iteration_state() { return std::tie(r_, hat_, p_, v_, r2_, hat2_, s2_, st_, t2_, inverse_hv_); }
  void resume(int64_t) {}

  typename Space::Vector x;

 private:
  /// ρ = r̂·r; where that is rounding, it starts anew with ρ = r·r.
  Scalar rho_or_anew() {
    Scalar rho = space_.dot(hat_, r_);
    const Scalar lost = space_.is_rounding(rho, hat2_, r2_, 200 * space_.unit_roundoff());
    start_anew_where(lost);
    space_.restore(lost, r2_, rho);
    return rho;
  }
  /// r̂ = r, and β = 0 in the next iteration, so that p = r.
  void start_anew_where(const Scalar& mask) {
    space_.restore(mask, r_, hat_);
    space_.restore(mask, r2_, hat2_);
    space_.restore(mask, zero_, inverse_hv_);
  }
  /// out = A v, or A M⁻¹ v with M⁻¹ v in z_; returns v·out and ‖out‖².
  std::array<Scalar, 2> apply_to(typename Space::Vector& v, typename Space::Vector& out) {
    if (!space_.is_preconditioned()) return space_.apply_with_dots(v, out);
    const Scalar out2 = space_.apply_with_dots(preconditioned(v), out)[1];
    return {space_.dot(v, out), out2};
  }
  /// v, or M⁻¹ v in z_.
  typename Space::Vector& preconditioned(typename Space::Vector& v) {
    if (!space_.is_preconditioned()) return v;
    space_.precondition(v, z_);
    return z_;
  }

  Space& space_;
  typename Space::Vector r_;  // r, and s between
  typename Space::Vector hat_;  // r̂
  typename Space::Vector p_;
  typename Space::Vector v_;  // A p
  typename Space::Vector t_;  // A s
  typename Space::Vector z_;  // M⁻¹ p, or M⁻¹ s
  Scalar r2_{}, hat2_{}, s2_{}, st_{}, t2_{};  // r·r, r̂·r̂, s·s, s·t, t·t
  Scalar inverse_hv_{};  // 1/(r̂·v)
  Scalar zero_{};
};

}  // namespace prdp
