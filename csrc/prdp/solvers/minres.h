#pragma once
#include <cmath>
#include <cstdint>
#include <tuple>
#include <utility>

#include "prdp/solvers/space.h"

namespace prdp {

constexpr ArraySizes arrays_of_minres(int64_t) { return {.vectors = 3, .numbers = 3, .arrays = 2}; }

/// The minimal residual of symmetric operators, definite or not (MINRES, Paige and Saunders 1975): Lanczos vectors v of
/// M⁻¹A, of length γ in the norm of M⁻¹, whose tridiagonal matrix is rotated into a triangle as it grows; x moves along
/// directions w = (z/γ - α₂ w₋ - α₃ w₋₋)/α₁ with z = M⁻¹ v. Memory does not grow. M must be positive definite; then
/// the norm of r in M⁻¹, |η|, never grows. (The notation is that of Elman, Silvester and Wathen 2014, algorithm 4.1.)
///
/// It breaks down where v·M⁻¹ v < 0: M is not positive definite. And it does where α₁ is rounding: A is singular there,
/// and b lies outside its range.
template <KrylovSpace Space>
class MinresMethod {
 public:
  using Scalar = typename Space::Scalar;
  using Vector = typename Space::Vector;
  static constexpr bool kHasRecursiveResidual = true;
  static constexpr bool kNeverGrows = true;

  explicit MinresMethod(Space& space)
      : x(space.vector()),
        space_(space),
        r_(space.vector()),
        v_(space.vector()),
        last_v_(space.vector()),
        w_(space.vector()),
        last_w_(space.vector()),
        az_(space.vector()),
        next_(space.vector()),
        z_(space.is_preconditioned() ? space.vector() : v_),
        next_z_(space.is_preconditioned() ? space.vector() : v_),
        parts_(space.template array<Vector>(kTerms)),
        weights_(space.template array<Scalar>(kTerms)) {}

  void start() {
    for (auto* vector : {&x, &last_v_, &w_, &last_w_, &az_}) space_.fill_zero(*vector);
    space_.copy(space_.b(), r_);
    begin_along(space_.b2());
  }
  void step() {
    const Scalar inverse = space_.ratio(one_, gamma_);
    const Scalar delta = make_lanczos_vector(inverse);  // v of this iteration is last_v_ from here on
    const Vector& z = space_.is_preconditioned() ? z_ : last_v_;
    const Scalar square = space_.is_preconditioned() ? space_.precondition(v_, next_z_) : space_.dot(v_, v_);
    const Scalar zero = space_.is_zero(square);
    const Scalar is_not_negative = space_.is_larger(square, square * 0) + zero;
    space_.break_down_unless_positive(square + zero, rr_);
    const Scalar gamma = root(square * is_not_negative);
    const Scalar a0 = c_ * delta - last_c_ * s_ * coupling_, a2 = s_ * delta + last_c_ * c_ * coupling_;
    const Scalar a3 = last_s_ * coupling_, a1 = root(a0 * a0 + square * is_not_negative);
    const Scalar row2 = delta * delta + coupling_ * coupling_ + square;
    const Scalar is_singular = space_.breaks_down(a1, 100 * row2, one_, rr_);  // α₁ is rounding
    space_.break_down_unless_positive(one_ - is_singular, rr_);
    last_c_ = c_;
    last_s_ = s_;
    c_ = space_.ratio(a0, a1);
    s_ = space_.ratio(gamma, a1);
    combine_into_next(z, inverse * space_.ratio(one_, a1), w_, -space_.ratio(a2, a1), last_w_, -space_.ratio(a3, a1));
    shift_in_next(w_, last_w_);
    move_along_w(c_ * eta_ * is_not_negative);
    eta_ = -s_ * eta_;
    last_gamma_ = gamma_;
    gamma_ = coupling_ = gamma;
    take_residual();
  }
  auto residual2() const { return rr_; }
  auto recompute_residual() {
    begin_along(space_.residual(x, r_));
    return rr_;
  }

  /// What the next iteration starts from, beside x; resume() once it has been put back.
  auto iteration_state() {
    return std::tie(r_, z_, v_, last_v_, w_, last_w_, rr_, eta_, gamma_, last_gamma_, coupling_, c_, last_c_, s_,
                    last_s_);
  }
  void resume(int64_t) {}

  Vector x;

 private:
  static constexpr int64_t kTerms = 3;

  /// Starts anew along the residual, which is in r and whose square is given.
  void begin_along(const Scalar& rr) {
    const Scalar zero = rr * 0;
    one_ = zero + 1;
    space_.assign(rr, rr_);
    space_.copy(r_, v_);
    const Scalar square = space_.is_preconditioned() ? space_.precondition(v_, z_) : rr;
    space_.break_down_unless_positive(square, rr_);
    space_.assign(root(square), gamma_);
    space_.assign(gamma_, eta_);
    for (auto* number : {&last_gamma_, &c_, &last_c_}) space_.assign(one_, *number);
    for (auto* number : {&coupling_, &s_, &last_s_}) space_.assign(zero, *number);
  }
  /// v = A z/γ - (δ/γ) v - (γ/γ₋) v₋, with 1/γ given; returns δ.
  Scalar make_lanczos_vector(const Scalar& inverse) {
    const Scalar delta = space_.apply_with_dots(space_.is_preconditioned() ? z_ : v_, az_)[0] * inverse * inverse;
    combine_into_next(az_, inverse, v_, -delta * inverse, last_v_, -space_.ratio(coupling_, last_gamma_));
    space_.keep_in_range(next_);  // where rounding grows as fast as the residual falls
    shift_in_next(v_, last_v_);
    return delta;
  }
  /// x += length w
  void move_along_w(const Scalar& length) {
    parts_[0] = w_;
    weights_[0] = length;
    space_.add_combination(weights_.data(), parts_, 1, x);
  }
  /// The square of ‖r‖; with a preconditioner r = s² r + c η v/γ, whose norm η alone does not tell.
  void take_residual() {
    if (!space_.is_preconditioned()) {
      rr_ = eta_ * eta_;
      return;
    }
    std::swap(z_, next_z_);
    combine_into_next(r_, s_ * s_, v_, space_.ratio(c_ * eta_, gamma_), v_, eta_ * 0);
    std::swap(r_, next_);
    rr_ = space_.dot(r_, r_);
  }
  /// √value, without an infinite derivative at zero.
  Scalar root(const Scalar& value) {
    using std::sqrt;
    const Scalar nothing = space_.is_zero(value);
    return sqrt(value + nothing) - nothing;
  }
  /// next = a u + b v + c w
  void combine_into_next(const Vector& u, const Scalar& a, const Vector& v, const Scalar& b, const Vector& w,
                         const Scalar& c) {
    parts_[0] = u;
    parts_[1] = v;
    parts_[2] = w;
    weights_[0] = a;
    weights_[1] = b;
    weights_[2] = c;
    space_.fill_zero(next_);
    space_.add_combination(weights_.data(), parts_, kTerms, next_);
  }
  /// `last` takes the value of `now`, and `now` that of next.
  void shift_in_next(Vector& now, Vector& last) {
    std::swap(last, now);
    std::swap(now, next_);
  }

  Space& space_;
  Vector r_, v_, last_v_, w_, last_w_, az_, next_, z_, next_z_;
  Scalar rr_{}, eta_{}, one_{};
  Scalar gamma_{}, last_gamma_{}, coupling_{};  // of v and of the one before; γ again, but 0 of the first v
  Scalar c_{}, last_c_{}, s_{}, last_s_{};      // of the last two rotations
  ArrayOf<Space, Vector> parts_;
  ArrayOf<Space, Scalar> weights_;
};

}  // namespace prdp
