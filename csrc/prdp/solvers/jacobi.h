#pragma once
#include <tuple>

namespace prdp {

/// u ← u + D⁻¹(b - A u). From zero the first iterate is D⁻¹ b for free; from then on one product an
/// iteration, which also tells the residual of the iterate that it starts from.
template <class Space>
class JacobiMethod {
 public:
  explicit JacobiMethod(Space& space)
      : x(space.vector()), space_(space), c_(space.vector()), next_(space.vector()) {}

  void start() {
    space_.divide_by_diagonal(space_.b(), c_);
    space_.fill_zero(x);
    space_.copy(c_, next_);
    residual2_ = space_.b2();
    ready_ = true;
  }
  void step() {
    if (!ready_) space_.template jacobi_sweep<false>(c_, x, next_);
    space_.advance(x, next_);
    ready_ = false;
  }
  auto residual2() {
    if (!ready_) residual2_ = space_.template jacobi_sweep<true>(c_, x, next_);
    ready_ = true;
    return residual2_;
  }
  auto recompute_residual() {
    auto r = space_.scratch();
    return space_.residual(x, r);
  }

  /// What the next iteration starts from; resume() once it has been put back.
  auto carried() { return std::tie(x); }
  void resume() { ready_ = false; }

  typename Space::Vector x;

 protected:
  Space& space_;
  typename Space::Vector c_, next_;  // D⁻¹ b; the iterate after x
  typename Space::Scalar residual2_{};
  bool ready_ = false;  // next_ and residual2_ belong to x
};

}  // namespace prdp
