#include "prdp/controller/linear_schedule.h"

#include <c10/util/Exception.h>

#include <algorithm>

namespace prdp {

LinearSchedule::LinearSchedule(int64_t initial, int64_t increment, int64_t maximum, std::optional<double> adjoint_ratio)
    : Controller(initial), initial_(initial), increment_(increment), maximum_(maximum), adjoint_ratio_(adjoint_ratio) {
  TORCH_CHECK_VALUE(initial >= 0, "LinearSchedule: initial must be >= 0, got ", initial);
  TORCH_CHECK_VALUE(increment >= 0, "LinearSchedule: increment must be >= 0, got ", increment);
  TORCH_CHECK_VALUE(maximum >= initial, "LinearSchedule: maximum must be >= initial = ", initial, ", got ", maximum);
  budget();
}

Budget LinearSchedule::budget() const {
  Budget budget{state_.max_iter};
  if (adjoint_ratio_) budget.adjoint_max_iter = adjoint_share("LinearSchedule", *adjoint_ratio_, state_.max_iter);
  return budget;
}

bool LinearSchedule::step(double metric, const Solves& solves) {
  check_solves(solves);
  const int64_t before = state_.max_iter;
  state_.max_iter = before + std::min(increment_, maximum_ - before);
  const bool raised = state_.max_iter > before;
  state_.history = {{metric, metric, before, raised, solves.error, solves.residual}};
  return raised;
}

void LinearSchedule::load_state(State state) {
  check_state(state, /*is_ignored=*/true);
  TORCH_CHECK_VALUE(state.max_iter >= initial_ && state.max_iter <= maximum_, "LinearSchedule: max_iter must lie in [",
                    initial_, ", ", maximum_, "], got ", state.max_iter);
  state_ = std::move(state);
}

}  // namespace prdp
