#include "prdp/controller/linear_schedule.h"

#include <c10/util/Exception.h>

#include <algorithm>

namespace prdp {

LinearSchedule::LinearSchedule(int64_t initial, int64_t increment, int64_t maximum)
    : initial_(initial), increment_(increment), maximum_(maximum), max_iter_(initial) {
  TORCH_CHECK_VALUE(initial >= 0, "LinearSchedule: initial must be >= 0, got ", initial);
  TORCH_CHECK_VALUE(increment >= 0, "LinearSchedule: increment must be >= 0, got ", increment);
  TORCH_CHECK_VALUE(maximum >= initial, "LinearSchedule: maximum must be >= initial = ", initial,
                    ", got ", maximum);
}

bool LinearSchedule::step(double, bool) {
  const int64_t before = max_iter_;
  max_iter_ = std::min(maximum_, max_iter_ + increment_);
  return max_iter_ > before;
}

void LinearSchedule::set_max_iter(int64_t max_iter) {
  TORCH_CHECK_VALUE(max_iter >= initial_ && max_iter <= maximum_,
                    "LinearSchedule: max_iter must lie in [", initial_, ", ", maximum_, "], got ",
                    max_iter);
  max_iter_ = max_iter;
}

}  // namespace prdp
