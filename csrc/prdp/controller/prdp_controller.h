#pragma once
#include <optional>

#include "prdp/controller/controller.h"

namespace prdp {

/// Settings of PRDP (paper, section 3 and appendix D) under the paper's names.
struct PRDPSettings {
  double tau_step = 0.95;   // τ_step: the metric is on a plateau if r > τ_step
  double tau_stop = 0.9;    // τ_stop: the last refinement helped if r_c < τ_stop
  int64_t delta = 3;        // δ >= 2: how many values r looks back
  int64_t window = 6;       // length of the exponential mean L̃, α = 2 / (window + 1); 1 does not smooth
  int64_t initial = 1;      // K₀ >= 0
  int64_t increment = 1;    // ΔK >= 1
  std::optional<int64_t> maximum{};  // K is never raised beyond
  double growth = 1.0;      // >= 1: K is raised to growth·K if that is more than K + ΔK
  std::optional<double> adjoint_ratio{};  // the adjoint's K is ⌈adjoint_ratio·K⌉; in (0, 1]
};

/// Progressively Refined Differentiable Physics: raises K when the smoothed metric L̃ reaches a
/// plateau, as long as the last refinement helped.
///   r   = L̃[-1] / L̃[-δ] <= τ_step             still improving, keep K
///   r_c = L̃[-1] / c, c = L̃ at the last refinement, +∞ before the first
///   r_c < τ_stop or r_c > 1 (beyond rounding)  c ← L̃[-1], refine
///   otherwise                                  K is enough, keep it
/// Two more rules keep K: fewer than δ + 1 values so far, and solves that already meet their
/// tolerance, which more iterations would not change.
class PRDPController final : public Controller {
 public:
  /// Raises ValueError for a setting outside its range, naming it.
  explicit PRDPController(PRDPSettings settings = {});

  Budget budget() const override;
  /// Raises ValueError, and changes nothing, unless the metric is finite and >= 0.
  bool step(double metric, const Solves& solves = {}) override;

  const PRDPSettings& settings() const { return settings_; }
  void load_state(State state) override;

 private:
  const char* name() const override { return "PRDPController"; }
  const char* remedy() const override {
    return "give a larger initial, a larger tau_stop, or take a ToleranceController";
  }
  bool stalled() const override;
  bool should_refine() const;

  PRDPSettings settings_;
};

}  // namespace prdp
