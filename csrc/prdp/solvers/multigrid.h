#pragma once
#include <cstdint>
#include <tuple>

#include "prdp/solvers/space.h"

namespace prdp {

/// x ← x + M⁻¹(b - A x), where M⁻¹ is a V-cycle. No products of vectors with each other.
template <VectorSpace Space>
class MultigridMethod {
 public:
  explicit MultigridMethod(Space& space) : x(space.vector()), space_(space), r_(space.vector()), z_(space.vector()) {}

  void start() {
    space_.fill_zero(x);
    space_.copy(space_.b(), r_);
    residual2_ = space_.b2();
    ready_ = true;
  }
  void step() {
    if (!ready_) space_.residual(x, r_);
    space_.precondition(r_, z_);
    space_.add(z_, x);
    ready_ = false;
  }
  auto residual2() { return recompute_residual(); }
  auto recompute_residual() {
    if (!ready_) residual2_ = space_.residual(x, r_);
    ready_ = true;
    return residual2_;
  }

  /// What the next iteration starts from; resume() once it has been put back.
  auto carried() { return std::tie(x); }
  void resume(int64_t) { ready_ = false; }

  typename Space::Vector x;

 private:
  Space& space_;
  typename Space::Vector r_, z_;  // residual; its correction
  typename Space::Scalar residual2_{};
  bool ready_ = false;  // r_ and residual2_ belong to x
};

}  // namespace prdp
