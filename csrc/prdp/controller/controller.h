#pragma once
#include <cstdint>
#include <limits>
#include <vector>

namespace prdp {

/// Decides how many iterations K the solver gets, from one training interval to the next.
class Controller {
 public:
  /// What was decided at one call of step().
  struct Record {
    double metric;
    double smoothed;   // L̃ with this metric
    int64_t max_iter;  // K before the decision
    bool refined;
  };
  /// All that step() depends on beside the settings; of a schedule K alone.
  struct State {
    int64_t max_iter;
    double checkpoint = std::numeric_limits<double>::infinity();  // c, L̃ at the last refinement
    std::vector<Record> history{};
  };

  virtual ~Controller() = default;
  /// K for the coming interval.
  virtual int64_t max_iter() const = 0;
  /// Called after each interval (and once before the first) with the metric to watch, smaller being
  /// better; `converged` tells that the solves already meet their tolerance. True if K was raised.
  virtual bool step(double metric, bool converged = false) = 0;
  virtual const State& state() const = 0;
  /// Raises ValueError, and changes nothing, for a state that these settings cannot have reached.
  virtual void load_state(State state) = 0;
};

}  // namespace prdp
