#include "prdp/controller/prdp_controller.h"

#include <c10/util/Exception.h>

#include <algorithm>
#include <cmath>

namespace prdp {

PRDPController::PRDPController(PRDPSettings settings) : Controller(settings.initial), settings_(settings) {
  const auto& s = settings_;
  TORCH_CHECK_VALUE(std::isfinite(s.tau_step) && s.tau_step > 0.0,
                    "PRDPController: tau_step must be finite and > 0, got ", s.tau_step);
  TORCH_CHECK_VALUE(std::isfinite(s.tau_stop) && s.tau_stop > 0.0,
                    "PRDPController: tau_stop must be finite and > 0, got ", s.tau_stop);
  TORCH_CHECK_VALUE(s.delta >= 2, "PRDPController: delta must be >= 2, got ", s.delta);
  TORCH_CHECK_VALUE(s.window >= 1, "PRDPController: window must be >= 1, got ", s.window);
  TORCH_CHECK_VALUE(s.initial >= 0, "PRDPController: initial must be >= 0, got ", s.initial);
  TORCH_CHECK_VALUE(s.increment >= 1, "PRDPController: increment must be >= 1, got ", s.increment);
  TORCH_CHECK_VALUE(!s.maximum || *s.maximum >= s.initial, "PRDPController: maximum must be >= initial = ", s.initial,
                    ", got ", s.maximum.value_or(0));
  TORCH_CHECK_VALUE(std::isfinite(s.growth) && s.growth >= 1.0, "PRDPController: growth must be finite and >= 1, got ",
                    s.growth);
  budget();
}

Budget PRDPController::budget() const {
  Budget budget{state_.max_iter};
  if (settings_.adjoint_ratio)
    budget.adjoint_max_iter = adjoint_share("PRDPController", *settings_.adjoint_ratio, state_.max_iter);
  return budget;
}

bool PRDPController::stalled() const {
  const auto& history = state_.history;
  if (static_cast<int64_t>(history.size()) <= settings_.delta) return false;
  // As a product, so that a metric of zero needs no division.
  return history.back().smoothed > settings_.tau_step * history[history.size() - settings_.delta].smoothed;
}

bool PRDPController::should_refine() const {
  if (!stalled()) return false;
  constexpr double rounding = 1e-12;
  const double newest = state_.history.back().smoothed;
  const bool paid = newest < settings_.tau_stop * state_.checkpoint;
  const bool worse = newest > (1.0 + rounding) * state_.checkpoint;
  return paid || worse;
}

bool PRDPController::step(double metric, const Solves& solves) {
  check_solves(solves);
  check_metric(metric);
  const double alpha = 2.0 / (static_cast<double>(settings_.window) + 1.0);
  const auto& history = state_.history;
  const double smoothed = history.empty() ? metric : std::lerp(history.back().smoothed, metric, alpha);
  state_.history.push_back({metric, smoothed, state_.max_iter, false, solves.error, solves.residual});

  const int64_t limit = settings_.maximum.value_or(std::numeric_limits<int64_t>::max());
  if (solves.converged || state_.max_iter >= limit || !should_refine()) return false;
  // Either sum may lie beyond the largest int64.
  const double grown = std::ceil(settings_.growth * static_cast<double>(state_.max_iter) - 1e-9);
  const int64_t added = std::min(settings_.increment, limit - state_.max_iter) + state_.max_iter;
  state_.checkpoint = smoothed;
  state_.max_iter = grown >= static_cast<double>(limit) ? limit : std::max(added, static_cast<int64_t>(grown));
  state_.history.back().refined = true;
  return true;
}

void PRDPController::load_state(State state) {
  TORCH_CHECK_VALUE(state.max_iter >= settings_.initial && (!settings_.maximum || state.max_iter <= *settings_.maximum),
                    "PRDPController: state has max_iter = ", state.max_iter,
                    ", expected >= initial = ", settings_.initial,
                    settings_.maximum ? c10::str(" and <= maximum = ", *settings_.maximum) : "");
  check_state(state);
  state_ = std::move(state);
}

}  // namespace prdp
