#include "prdp/controller/tolerance_controller.h"

#include <c10/util/Exception.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <sstream>

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
  constexpr double loosest = 0.5;
  const double wanted = std::max(settings_.adjoint_floor, rtol() / settings_.adjoint_ratio);
  return std::max(rtol(), std::min(loosest, wanted));
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

std::string ToleranceController::about_adjoint() const {
  // As after sparse sensors, or of an indefinite A: with adjoint solves to 0.5, gradients were seen at more than a
  // right angle to the exact one, and no error fell to tighten them.
  constexpr size_t patience = 20;
  constexpr double loose = 0.1, fallen = 0.9;
  const auto& history = state_.history;
  if (history.size() < patience || adjoint_rtol() <= loose || state_.checkpoint < fallen * history.front().metric)
    return {};
  std::ostringstream text;
  text << name() << ": the error has not fallen in " << history.size() << " calls, and adjoint solves to "
       << adjoint_rtol() << " may have a gradient that points uphill; take adjoint_ratio=1";
  return text.str();
}

void ToleranceController::load_state(State state) {
  check_state(state);
  TORCH_CHECK_VALUE(state.max_iter >= 1, name(), ": state has max_iter = ", state.max_iter, ", expected >= 1");
  state.max_iter = settings_.maximum;
  state_ = std::move(state);
}

}  // namespace prdp
