#pragma once
#include <cstdint>
#include <tuple>

#include "prdp/solvers/space.h"

namespace prdp {

/// Conjugate gradients for symmetric definite operators of either sign, preconditioned by the magnitude of
/// the diagonal: z = |D|⁻¹ r, α = r·z / p·Ap; u += α p; r -= α A p; p ← z + β p. The residual that it is
/// judged by is r itself.
template <WeightedSpace Space>
class PreconditionedConjugateGradientMethod {
 public:
  static constexpr bool kHasRecursiveResidual = true;

  explicit PreconditionedConjugateGradientMethod(Space& space)
      : x(space.vector()),
        space_(space),
        r_(space.vector()),
        p_(space.vector()),
        q_(space.vector()),
        weights_(space.vector()) {}

  void start() {
    space_.fill_zero(x);
    space_.inverse_diagonal(weights_);
    space_.copy(space_.b(), r_);
    space_.weigh(weights_, r_, p_);
    rr_ = space_.b2();
    rz_ = pp_ = space_.weighted_square(weights_, r_);
  }
  void step() {
    const auto [pq, qq] = space_.apply_with_dots(p_, q_);
    alpha_ = space_.step_length(rz_, pq, pp_, weights_, q_, qq);
    const auto [rr, rz] = space_.descend(alpha_, p_, q_, weights_, x, r_);
    beta_ = space_.ratio(rz, rz_);
    space_.xpby(weights_, r_, beta_, p_);
    pp_ = rz + beta_ * beta_ * pp_;  // r and p before are orthogonal
    rr_ = rr;
    rz_ = rz;
  }
  auto residual2() const { return rr_; }
  auto recompute_residual() {
    rr_ = space_.residual(x, r_);
    rz_ = space_.weighted_square(weights_, r_);
    space_.weigh(weights_, r_, p_);
    space_.assign(rz_, pp_);
    return rr_;
  }

  /// What the next iteration starts from, beside x; resume() once it has been put back.
  auto carried() { return std::tie(r_, p_, rr_, rz_, pp_); }
  void resume(int64_t) {}

  typename Space::Vector x;

 private:
  Space& space_;
  typename Space::Vector r_, p_, q_, weights_;  // residual; direction; A p; |D|⁻¹, scaled
  typename Space::Scalar rr_{}, rz_{}, pp_{};   // r·r, r·z, p·|D|p
  typename Space::Scalar alpha_{}, beta_{};
};

}  // namespace prdp
