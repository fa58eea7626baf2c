#pragma once
#include "prdp/controller/controller.h"

namespace prdp {

struct ToleranceSettings {
  double ratio = 0.1;          // of the tolerance to the error; in (0, 1)
  double adjoint_ratio = 0.1;  // of the tolerance to the adjoint's, and of its K to K; in (0, 1]
  double floor = 1e-5;         // no tolerance is smaller; > 0
  double adjoint_floor = 1e-2; // and none of the adjoint; > 0
  int64_t maximum = 10000;     // K, a cap on what a solve may take; >= 1
};

/// Ties the tolerance of the solves to the error of what is trained:
///   rtol = max(floor, ratio · min(1, e)), e the smallest relative error so far, 1 before the first
/// and the adjoint's is rtol / adjoint_ratio, at most 1/2, since a solve to 1 is none, and at least `adjoint_floor`: it
/// is relative to a cotangent that shrinks with the error, and a descent needs no better gradient late than early. K is
/// a cap only, and ⌈adjoint_ratio·K⌉ that of the adjoint.
/// The forcing term of inexact Newton methods (Eisenstat and Walker 1996) and of optimisation with
/// approximate gradients (Pedregosa 2016), applied to training.
class ToleranceController final : public Controller {
 public:
  /// Raises ValueError for a setting outside its range, naming it.
  explicit ToleranceController(ToleranceSettings settings = {});

  double rtol() const { return rtol_for(state_.checkpoint); }
  /// What a smallest error so far makes of rtol.
  double rtol_for(double smallest) const;
  double adjoint_rtol() const;
  int64_t max_iter() const override { return settings_.maximum; }
  Budget budget() const override;
  /// `error`: relative, as Solves::error says it. True if the tolerance became smaller. Raises ValueError,
  /// and changes nothing, unless the error is finite and >= 0.
  bool step(double error, const Solves& solves = {}) override;

  const ToleranceSettings& settings() const { return settings_; }
  const State& state() const override { return state_; }
  void load_state(State state) override;

 private:
  const char* name() const override { return "ToleranceController"; }
  const char* remedy() const override { return "raise maximum or take a solver that needs fewer iterations"; }
  bool stalled() const override { return true; }  // its metric is the error, so nobody asks

  ToleranceSettings settings_;
  State state_;
};

}  // namespace prdp
