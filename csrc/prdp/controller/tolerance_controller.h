#pragma once
#include "prdp/controller/controller.h"

namespace prdp {

struct ToleranceSettings {
  double ratio = 0.1;          // tolerance / error; in (0, 1)
  double adjoint_ratio = 0.1;  // rtol / adjoint_rtol, and K of the adjoint solve / K; in (0, 1]
  double floor = 1e-5;         // the smallest tolerance; in (0, 1)
  double adjoint_floor = 1e-2; // the smallest tolerance of the adjoint solve; in (0, 1)
  int64_t maximum = 10000;     // K, only a limit; >= 1
};

/// Ties the tolerance of the solves to the error of what is trained:
///   rtol         = max(floor, ratio · min(1, e)), e being the smallest relative error so far; before the first,
///                  max(floor, 1e-3)
///   adjoint_rtol = min(1/10, rtol / adjoint_ratio), but at least adjoint_floor and rtol
/// Looser adjoint solves give directions in which a descent gets nowhere, hence 1/10. The floor is there because the
/// cotangent shrinks with the error, and gradients need not become more accurate late. K, and ⌈adjoint_ratio·K⌉ for the
/// adjoint solve, are only limits.
/// Source: the forcing term of inexact Newton methods (Eisenstat and Walker 1996) and of optimisation with
/// approximate gradients (Pedregosa 2016), applied to training.
class ToleranceController final : public Controller {
 public:
  /// Raises ValueError for a setting outside its range, naming it.
  explicit ToleranceController(ToleranceSettings settings = {});

  double rtol() const { return rtol_for(state_.checkpoint); }
  /// The rtol for this smallest error so far; infinite: none is known, and loose solves might spoil a good start.
  double rtol_for(double smallest) const;
  double adjoint_rtol() const;
  Budget budget() const override;
  /// `error` is relative, as Solves::error. Returns true if the tolerance became smaller. Raises ValueError, and
  /// changes nothing, unless the error is finite and >= 0.
  bool step(double error, const Solves& solves = {}) override;

  const ToleranceSettings& settings() const { return settings_; }
  void load_state(State state) override;

 private:
  const char* name() const override { return "ToleranceController"; }
  const char* metric_name() const override { return "error"; }
  bool has_relative_metric() const override { return true; }
  const char* remedy() const override {
    return "raise maximum, or take a solver that needs fewer iterations, as with the preconditioner multigrid, or "
           "float64 if it stalls";
  }
  bool stalled() const override { return true; }  // not used: its metric is the error
  double asked_for() const override;

  ToleranceSettings settings_;
};

}  // namespace prdp
