#pragma once
#include <cmath>
#include <cstdint>
#include <tuple>
#include <utility>

#include "prdp/solvers/space.h"

namespace prdp {

/// The minimal residual of symmetric operators, definite or not (MINRES, Paige and Saunders 1975), by directions p
/// whose products q = A p are orthogonal (Ashby, Manteuffel and Saylor 1990): with z = M⁻¹ q, α = r·z / q·z, x += α p,
/// r -= α q, and the next p is z / √(q·z) less its parts along the last two. It takes one product, and no quotient
/// vanishes before A p does: A may have eigenvalues of both signs. M must be positive definite; then ‖r‖ in the norm of
/// M⁻¹ never grows.
template <KrylovSpace Space>
class MinresMethod {
 public:
  using Scalar = typename Space::Scalar;
  using Vector = typename Space::Vector;
  static constexpr bool kHasRecursiveResidual = true;

  explicit MinresMethod(Space& space)
      : x(space.vector()),
        space_(space),
        r_(space.vector()),
        z_(space.vector()),
        az_(space.vector()),
        p_(space.vector()),
        q_(space.vector()),
        last_p_(space.vector()),
        last_q_(space.vector()),
        next_(space.vector()),
        parts_(space.template array<Vector>(kTerms)),
        weights_(space.template array<Scalar>(kTerms)) {}

  void start() {
    for (auto* vector : {&x, &p_, &q_, &last_p_, &last_q_}) space_.fill_zero(*vector);
    space_.copy(space_.b(), r_);
    begin_along(space_.b2());
  }
  void step() {
    using std::sqrt;
    space_.apply(z_, az_);
    // Of the first direction 1, 0 and 0; the root of zero has no derivative.
    const Scalar first = space_.is_zero(qz_);
    const Scalar scale = space_.ratio(sqrt(qz_ + first), qz_) + first;
    const Scalar along = scale * space_.ratio(space_.dot(az_, z_), qz_);
    const Scalar grown = space_.ratio(qz_, last_qz_), second = space_.is_zero(grown);
    const Scalar along_last = sqrt(grown + second) - second;
    combine(z_, scale, p_, along, last_p_, along_last);
    combine(az_, scale, q_, along, last_q_, along_last);
    space_.assign(qz_, last_qz_);
    set_z(q_);
    space_.assign(space_.dot(q_, z_), qz_);
    space_.break_down_unless_positive(qz_, rr_);
    rr_ = space_.descend(space_.ratio(space_.dot(r_, z_), qz_), p_, q_, x, r_);
  }
  auto residual2() const { return rr_; }
  auto recompute_residual() {
    begin_along(space_.residual(x, r_));
    return rr_;
  }

  /// What the next iteration starts from, beside x; resume() once it has been put back.
  auto carried() { return std::tie(r_, z_, p_, q_, last_p_, last_q_, rr_, qz_, last_qz_); }
  void resume(int64_t) {}

  Vector x;

 private:
  static constexpr int64_t kTerms = 3;

  /// Starts anew along the residual, which is in r and whose square is given.
  void begin_along(const Scalar& rr) {
    space_.assign(rr, rr_);
    space_.assign(rr * 0, qz_);
    space_.assign(rr * 0, last_qz_);
    set_z(r_);
  }
  void set_z(const Vector& from) {
    if (space_.is_preconditioned()) space_.precondition(from, z_);
    else space_.copy(from, z_);
  }
  /// v, and `last` with it, go one direction further: a fresh - b v - c last.
  void combine(const Vector& fresh, const Scalar& a, Vector& v, const Scalar& b, Vector& last, const Scalar& c) {
    parts_[0] = fresh;
    parts_[1] = v;
    parts_[2] = last;
    weights_[0] = a;
    weights_[1] = -b;
    weights_[2] = -c;
    space_.fill_zero(next_);
    space_.add_combination(weights_.data(), parts_, kTerms, next_);
    std::swap(last, v);
    std::swap(v, next_);
  }

  Space& space_;
  Vector r_, z_, az_, p_, q_, last_p_, last_q_, next_;  // z = M⁻¹ q, of the first direction M⁻¹ r; A z; q = A p
  Scalar rr_{}, qz_{}, last_qz_{};  // r·r; q·z of this direction and of the last, 0 before the first
  ArrayOf<Space, Vector> parts_;
  ArrayOf<Space, Scalar> weights_;
};

}  // namespace prdp
