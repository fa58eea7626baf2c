#pragma once
#include <cstdint>

namespace prdp {

/// Decides how many iterations K the solver gets, from one training interval to the next.
class Controller {
 public:
  virtual ~Controller() = default;
  /// K for the coming interval.
  virtual int64_t max_iter() const = 0;
  /// Called after each interval (and once before the first) with the metric to watch, smaller being
  /// better; `converged` tells that the solves already meet their tolerance. True if K was raised.
  virtual bool step(double metric, bool converged = false) = 0;
};

}  // namespace prdp
