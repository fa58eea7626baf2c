#pragma once
#include <algorithm>
#include <cstdint>
#include <tuple>

#include "prdp/solvers/space.h"

namespace prdp {

/// Of how many iterations Chebyshev's method keeps the weights.
inline constexpr int64_t kWeightsAtOnce = 64;
constexpr ArraySizes arrays_of_chebyshev(int64_t) { return {.numbers = kWeightsAtOnce, .arrays = 1}; }

/// u ← u + D⁻¹(b - A u). From zero the first iterate is D⁻¹ b for free; from then on one product an
/// iteration. A product whose residual is looked at makes the next iterate as well.
///
/// Accelerated, it is Chebyshev's semi-iteration (Golub and Varga 1961): with ρ, the spectral radius of
/// I - D⁻¹A, whose eigenvalues come in pairs ±μ, u_{k+1} = u_{k-1} + ω_{k+1} (u_k + D⁻¹(b - A u_k) - u_{k-1}),
/// ω₁ = 1, ω₂ = 1/(1 - ρ²/2), ω_{k+1} = 1/(1 - ρ² ω_k/4). No dot products.
template <SweepingSpace Space>
class JacobiMethod {
 public:
  explicit JacobiMethod(Space& space) : JacobiMethod(space, /*accelerated=*/false) {}

  void start() {
    space_.divide_by_diagonal(space_.b(), c_);
    space_.fill_zero(x);
    space_.copy(c_, next_);
    residual2_ = space_.b2();
    ready_ = true;
    done_ = first_weight_ = 0;  // the sample before may have had another spectrum
  }
  void step(int64_t n) {
    done_ += n;
    if (ready_) {
      space_.advance(x, next_);
      --n;
    }
    for (int64_t part; n > 0; n -= part) {
      part = accelerated_ ? std::min(n, kWeightsAtOnce) : n;
      space_.sweeps(c_, x, next_, part, weights(done_ - n, part));
    }
    ready_ = false;
  }
  auto residual2() {
    if (!ready_) residual2_ = space_.measured_sweep(c_, x, next_, weights(done_, 1));
    ready_ = true;
    return residual2_;
  }
  /// Of its own, as a sweep at a fixed point of its rounding changes nothing, however large b - A x is.
  auto recompute_residual() { return space_.residual(x, r_); }
  /// With a symmetric iteration matrix G, ‖Gr‖² = r·G²r <= ‖r‖ ‖G²r‖: the residual falls by ever less.
  bool residual_is_log_convex() const { return !accelerated_ && space_.sweeps_are_log_convex(); }

  /// What the next iteration starts from; resume() once it has been put back, as after `done` iterations.
  auto iteration_state() { return std::tie(x); }
  void resume(int64_t done) {
    ready_ = false;
    done_ = done;
  }

  typename Space::Vector x;

 protected:
  using Scalar = typename Space::Scalar;

  JacobiMethod(Space& space, bool accelerated)
      : x(space.vector()),
        space_(space),
        accelerated_(accelerated),
        c_(space.vector()),
        next_(space.vector()),
        r_(space.vector()),
        omega_(space.template array<Scalar>(accelerated ? kWeightsAtOnce : 0)) {}

  /// ω of n iterations after the first `first`, which is at least one; null without acceleration.
  const Scalar* weights(int64_t first, int64_t n) {
    if (!accelerated_) return nullptr;
    if (first_weight_ == 0 || first < first_weight_) {
      radius2_ = space_.radius2();
      omega_[0] = 1 / (1 - radius2_ / 2);
      first_weight_ = 1;
    }
    for (; first_weight_ < first; ++first_weight_) omega_[0] = 1 / (1 - radius2_ * omega_[0] / 4);
    for (int64_t i = 1; i < n; ++i) omega_[i] = 1 / (1 - radius2_ * omega_[i - 1] / 4);
    return omega_.data();
  }

  Space& space_;
  bool accelerated_;
  typename Space::Vector c_;     // D⁻¹ b
  typename Space::Vector next_;  // the iterate after x if ready_; else the one before it, for Chebyshev
  typename Space::Vector r_;     // of recompute_residual()
  Scalar residual2_{};
  bool ready_ = false;  // next_ and residual2_ belong to x
  int64_t done_ = 0;
  Scalar radius2_{};                 // ρ²
  ArrayOf<Space, Scalar> omega_;     // of some iterations
  int64_t first_weight_ = 0;         // the iteration of omega_[0], counted from zero; 0: there are none yet
};

template <SweepingSpace Space>
class ChebyshevMethod : public JacobiMethod<Space> {
 public:
  static constexpr bool kOscillates = true;
  explicit ChebyshevMethod(Space& space) : JacobiMethod<Space>(space, /*accelerated=*/true) {}

  auto iteration_state() { return std::tie(this->x, this->next_); }
};

}  // namespace prdp
