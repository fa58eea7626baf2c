#pragma once
#include <cstdint>

namespace prdp {

/// u ← u + D⁻¹(b - A u). From zero the first iterate is D⁻¹ b for free; from then on one product an
/// iteration. A product whose residual is looked at makes the next iterate as well.
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
  void step(int64_t n) {
    if (ready_) {
      space_.advance(x, next_);
      --n;
    }
    if (n > 0) space_.jacobi_sweeps(c_, x, next_, n);
    ready_ = false;
  }
  auto residual2() {
    if (!ready_) residual2_ = space_.jacobi_sweep(c_, x, next_);
    ready_ = true;
    return residual2_;
  }
  auto recompute_residual() { return residual2(); }  // it is that of x, not of a recurrence
  /// With a symmetric iteration matrix G, ‖Gr‖² = r·G²r <= ‖r‖ ‖G²r‖: the residual falls by ever less.
  bool residual_is_log_convex() const { return space_.sweeps_contract(); }

  typename Space::Vector x;

 private:
  Space& space_;
  typename Space::Vector c_, next_;  // D⁻¹ b; the iterate after x
  typename Space::Scalar residual2_{};
  bool ready_ = false;  // next_ and residual2_ belong to x
};

}  // namespace prdp
