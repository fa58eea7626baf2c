#pragma once
#include "prdp/controller/controller.h"

namespace prdp {

/// The manual schedule: K = initial + increment·(steps so far), at most `maximum`. increment = 0 is a
/// constant K.
class LinearSchedule final : public Controller {
 public:
  /// Raises ValueError unless 0 <= initial <= maximum and increment >= 0.
  LinearSchedule(int64_t initial, int64_t increment, int64_t maximum);

  int64_t max_iter() const override { return state_.max_iter; }
  bool step(double metric = 0.0, bool converged = false) override;
  const State& state() const override { return state_; }
  void load_state(State state) override;

  int64_t initial() const { return initial_; }
  int64_t increment() const { return increment_; }
  int64_t maximum() const { return maximum_; }

 private:
  int64_t initial_, increment_, maximum_;
  State state_;
};

}  // namespace prdp
