#include "prdp/controller/tolerance_controller.h"

#include <c10/util/Exception.h>

#include <algorithm>
#include <cmath>
#include <limits>

namespace prdp {

ToleranceController::ToleranceController(ToleranceSettings settings)
    : Controller(settings.maximum), settings_(settings) {
  const auto& s = settings_;
  TORCH_CHECK_VALUE(s.ratio > 0.0 && s.ratio < 1.0, "ToleranceController: ratio must be > 0 and < 1, got ", s.ratio);
  TORCH_CHECK_VALUE(s.floor > 0.0 && s.floor < 1.0, "ToleranceController: floor must be > 0 and < 1, got ", s.floor);
  TORCH_CHECK_VALUE(s.adjoint_floor > 0.0 && s.adjoint_floor < 1.0,
                    "ToleranceController: adjoint_floor must be > 0 and < 1, got ", s.adjoint_floor);
  TORCH_CHECK_VALUE(s.maximum >= 1, "ToleranceController: maximum must be >= 1, got ", s.maximum);
  budget();  // refuses an adjoint_ratio outside (0, 1]
}

double ToleranceController::rtol_for(double smallest) const {
  constexpr double before_any = 1e-3;
  return std::max(settings_.floor, std::isinf(smallest) ? before_any : settings_.ratio * std::min(1.0, smallest));
}

double ToleranceController::adjoint_rtol() const {
  // At 1/2 a Krylov method leaves out of the gradient what matters: its cosine with the exact one, of a field seen by
  // two sensors, fell to 0.33, at 1/5 to 0.75, at 1/10 to 0.94, and emulators ended up to 18 times as far off.
  constexpr double loosest = 0.1;
  return std::max({rtol(), settings_.adjoint_floor, std::min(loosest, rtol() / settings_.adjoint_ratio)});
}

Budget ToleranceController::budget() const {
  return {max_iter(), adjoint_share(name(), settings_.adjoint_ratio, max_iter()), rtol(), adjoint_rtol()};
}

bool ToleranceController::step(double error, const Solves& solves) {
  check_solves(solves);
  check_metric(error);
  const double before = rtol();
  state_.checkpoint = std::min(state_.checkpoint, error);
  const bool tightened = rtol() < before;
  state_.history.push_back({error, state_.checkpoint, state_.max_iter, tightened, error, solves.residual});
  return tightened;
}

double ToleranceController::asked_for() const {
  const auto& history = state_.history;
  return rtol_for(history.size() > 1 ? history[history.size() - 2].smoothed : std::numeric_limits<double>::infinity());
}

void ToleranceController::load_state(State state) {
  check_state(state);
  TORCH_CHECK_VALUE(state.max_iter >= 1, name(), ": state has max_iter = ", state.max_iter, ", expected >= 1");
  state.max_iter = settings_.maximum;
  state_ = std::move(state);
}

}  // namespace prdp
