#pragma once
#include "prdp/controller/controller.h"

namespace prdp {

/// A manual schedule: K = initial + increment·(calls of step()), at most `maximum`. increment = 0 keeps K constant. The
/// metric is ignored.
class LinearSchedule final : public Controller {
 public:
  /// The adjoint solve gets ⌈adjoint_ratio·K⌉ iterations; without a ratio the stepper decides. Raises ValueError unless
  /// 0 <= initial <= maximum, increment >= 0 and 0 < adjoint_ratio <= 1.
  LinearSchedule(int64_t initial, int64_t increment, int64_t maximum, std::optional<double> adjoint_ratio = {});

  Budget budget() const override;
  bool step(double metric = 0.0, const Solves& solves = {}) override;
  void load_state(State state) override;

  int64_t initial() const { return initial_; }
  int64_t increment() const { return increment_; }
  int64_t maximum() const { return maximum_; }
  std::optional<double> adjoint_ratio() const { return adjoint_ratio_; }

 private:
  const char* name() const override { return "LinearSchedule"; }
  const char* remedy() const override { return "give a larger K, or take a ToleranceController"; }
  bool stalled() const override { return false; }  // it ignores the metric

  int64_t initial_, increment_, maximum_;
  std::optional<double> adjoint_ratio_;
};

}  // namespace prdp
