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
        p_(space.vector()),
        q_(space.vector()),
        last_p_(space.vector()),
        last_q_(space.vector()),
        next_(space.vector()),
        az_(space.vector()),
        z_(space.is_preconditioned() ? space.vector() : q_),
        parts_(space.template array<Vector>(kTerms)),
        weights_(space.template array<Scalar>(kTerms)) {}

  void start() {
    for (auto* vector : {&x, &last_p_, &last_q_}) space_.fill_zero(*vector);
    space_.copy(space_.b(), r_);
    begin_along(space_.b2());
  }
  void step() {
    using std::sqrt;
    const Scalar qz = space_.is_preconditioned() ? space_.precondition(q_, z_) : space_.dot(q_, q_);
    space_.break_down_unless_positive(qz, rr_);
    const Vector& z = space_.is_preconditioned() ? z_ : q_;
    rr_ = space_.descend(space_.ratio(space_.dot(r_, z), qz), p_, q_, x, r_);
    space_.apply(z, az_);
    const Scalar scale = space_.ratio(sqrt(qz), qz), along = scale * space_.ratio(space_.dot(az_, z), qz);
    const Scalar along_last = sqrt(space_.ratio(qz, last_qz_));
    combine(z, scale, p_, along, last_p_, along_last);
    combine(az_, scale, q_, along, last_q_, along_last);
    space_.assign(qz, last_qz_);
  }
  auto residual2() const { return rr_; }
  auto recompute_residual() {
    begin_along(space_.residual(x, r_));
    return rr_;
  }

  /// What the next iteration starts from, beside x; resume() once it has been put back.
  auto carried() { return std::tie(r_, p_, q_, last_p_, last_q_, rr_, last_qz_); }
  void resume(int64_t) {}

  Vector x;

 private:
  static constexpr int64_t kTerms = 3;

  /// Starts anew along the residual, which is in r and whose square is given.
  void begin_along(const Scalar& rr) {
    space_.assign(rr, rr_);
    space_.assign(rr * 0, last_qz_);
    if (space_.is_preconditioned()) space_.precondition(r_, p_);
    else space_.copy(r_, p_);
    space_.apply(p_, az_);
    space_.copy(az_, q_);
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
  Vector r_, p_, q_, last_p_, last_q_, next_, az_, z_;  // q = A p; A z; z = M⁻¹ q, or q itself
  Scalar rr_{}, last_qz_{};  // r·r; q·z of the last direction, 0 before
  ArrayOf<Space, Vector> parts_;
  ArrayOf<Space, Scalar> weights_;
};

}  // namespace prdp
