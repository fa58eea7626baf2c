#include "prdp/controller/controller.h"

#include <c10/util/Exception.h>

#include <algorithm>
#include <cmath>
#include <iomanip>
#include <sstream>

namespace prdp {

namespace {

/// The residual may make up the error from this share on. Measured: up to .28 trainings end as well as with
/// converged solves, from .38 on most do not (docs/refinement.md).
constexpr double kShareOfError = 0.3;
/// Too large for whatever the metric may be.
constexpr double kLargeResidual = 0.1;
/// A metric grows where the last `kGrown` of them are more than `kGrowth` times the least; not where all of them are
/// rounding, next to the largest. One that was never below its first value in `kLong` calls may be an accuracy: there
/// less growth tells.
constexpr size_t kGrown = 3, kLong = 20;
/// Larger than what a relative error is for long.
constexpr double kNoRelativeError = 5.0;
constexpr double kGrowth = 2.0, kGrowthFromFirst = 1.1, kRoundingOfMetric = 1e-3;

bool is_size(double x) { return std::isfinite(x) && x >= 0.0; }

}  // namespace

std::optional<std::string> Controller::warning() const {
  auto text = about_metric();
  const auto residual = about_residual();
  if (!text.empty() && !residual.empty()) text += ". ";
  text += residual;
  return text.empty() ? std::nullopt : std::optional(text);
}

void Controller::check_metric(double metric) {
  const bool good = is_size(metric);
  refused_ = good ? std::nullopt : std::optional(metric);
  TORCH_CHECK_VALUE(good, name(), ": ", metric_name(), " must be finite and >= 0, got ", metric,
                    metric < 0.0 ? "; smaller is better, as in 1 - accuracy" : "");
}

void Controller::check_solves(const Solves& solves) {
  for (const auto& [what, value] : {std::pair("error", solves.error), std::pair("residual", solves.residual)})
    TORCH_CHECK_VALUE(!value || is_size(*value), name(), ": ", what, " must be finite and >= 0, got ", *value);
  idle_ = solves.idle;
  failed_ = solves.failed;
}

void Controller::check_state(const State& state, bool is_ignored) const {
  TORCH_CHECK_VALUE(state.max_iter >= 0, name(), ": state has max_iter = ", state.max_iter, ", expected >= 0");
  TORCH_CHECK_VALUE(state.checkpoint >= 0.0, name(), ": state has checkpoint = ", state.checkpoint, ", expected >= 0");
  for (const auto& record : state.history) {
    TORCH_CHECK_VALUE(is_ignored || (is_size(record.metric) && is_size(record.smoothed)), name(),
                      ": state has a metric that is not finite and >= 0");
    TORCH_CHECK_VALUE(record.max_iter >= 0, name(), ": state has a record of max_iter = ", record.max_iter,
                      ", expected >= 0");
    for (const auto& value : {record.error, record.residual})
      TORCH_CHECK_VALUE(!value || is_size(*value), name(),
                        ": state has a record of an error or residual that is not finite and >= 0, ", *value);
  }
}

std::string Controller::about_metric() const {
  const auto& history = state().history;
  std::ostringstream text;
  text << std::scientific << std::setprecision(1) << name() << ": ";
  if (refused_) {
    text << "the last " << metric_name() << " was " << *refused_ << ", and nothing was changed. Go back to the weights "
         << "before it, with a smaller learning rate";
    return text.str();
  }
  if (history.size() <= kGrown) return {};
  const auto [least, most] = std::minmax_element(history.begin(), history.end(),
                                                 [](const Record& a, const Record& b) { return a.metric < b.metric; });
  const bool never_fell = history.size() >= kLong && least == history.begin();
  const double growth = never_fell ? kGrowthFromFirst : kGrowth;
  const double bound = std::max(growth * least->metric, kRoundingOfMetric * most->metric);
  const bool grows =
      std::all_of(history.end() - kGrown, history.end(), [&](const Record& r) { return r.metric > bound; });
  if (!grows && has_relative_metric() && history.size() >= kLong && least->metric > kNoRelativeError) {
    text << "the " << metric_name() << " was " << least->metric << " at least in " << history.size()
         << " intervals: is it relative, ‖u - u_ref‖ / ‖u_ref‖? The tolerance follows what is below 1";
    return text.str();
  }
  if (!grows) return {};
  text << "the " << metric_name() << " grows: " << history.back().metric << " after " << least->metric
       << " in interval " << least - history.begin()
       << "; lower the learning rate, solve further, or go back to the weights of then";
  if (never_fell) text << ". If larger is better, pass 1 - accuracy, or the like";
  return text.str();
}

std::string Controller::about_residual() const {
  const auto& history = state().history;
  if (failed_ > 0.5)
    return std::string(name()) +
           ": most samples of the last solves failed, and what is trained learns nothing from them; the status of "
           "each says why";
  if (idle_ > 0.5)
    return std::string(name()) +
           ": most of the last solves took no iteration, as their start met rtol: what is trained, or a step in time, "
           "hardly changes their solution. Start them from zero, solve for the change, or take a finer rtol";
  if (history.empty() || !history.back().residual) return {};
  const auto& last = history.back();
  const double residual = *last.residual;
  if (residual <= std::max(kSmallResidual, asked_for())) return {};
  std::ostringstream text;
  text << std::scientific << std::setprecision(1) << name() << ": the solves stop at a residual of " << residual
       << " (K = " << last.max_iter << "), ";
  if (last.error) {
    // The residual is relative to a state that holds the error as well.
    if (residual <= kShareOfError * *last.error / (1.0 + *last.error)) return {};
    text << "too far off for an error of " << *last.error << ": what is trained may have learned the solver's error";
  } else {
    if (residual <= kLargeResidual || !stalled()) return {};
    text << "and the metric no longer falls: what is trained may have learned the solver's error";
  }
  text << "; " << remedy();
  return text.str();
}

int64_t adjoint_share(const char* who, double ratio, int64_t max_iter) {
  TORCH_CHECK_VALUE(ratio > 0.0 && ratio <= 1.0, who, ": adjoint_ratio must be > 0 and <= 1, got ", ratio);
  const auto most = static_cast<double>(max_iter);
  const double share = std::ceil(ratio * most - 1e-9);
  // Beyond 2⁵³ `most` is rounded, and may lie beyond the largest int64.
  return share < most ? std::max<int64_t>(1, static_cast<int64_t>(share)) : max_iter;
}

}  // namespace prdp
