#include "prdp/solvers/warnings.h"

#include <c10/util/Exception.h>

#include <atomic>
#include <bit>
#include <map>
#include <mutex>
#include <unordered_map>

#include "prdp/error_text.h"

namespace prdp {

namespace {

void warn_by_torch(const std::string& text) { TORCH_WARN(text); }

std::atomic<WarningSink>& warning_sink() {
  static std::atomic<WarningSink> sink{warn_by_torch};
  return sink;
}

thread_local int64_t step_now = 0, steps_in_all = 0;  // of a rollout, while it runs

/// "step 3 of 10: "; nothing outside of a rollout.
std::string step_prefix() {
  return step_now > 0 ? "step " + std::to_string(step_now) + " of " + std::to_string(steps_in_all) + ": " : "";
}

}  // namespace

void set_warning_sink(WarningSink sink) { warning_sink() = sink ? sink : warn_by_torch; }

FailuresOfStep::FailuresOfStep(int64_t step, int64_t steps)
    : step_before_(std::exchange(step_now, step)), steps_before_(std::exchange(steps_in_all, steps)) {}
FailuresOfStep::~FailuresOfStep() {
  step_now = step_before_;
  steps_in_all = steps_before_;
}
std::pair<int64_t, int64_t> FailuresOfStep::now() { return {step_now, steps_in_all}; }

void raise_or_warn(const std::string& text, OnFailure on_failure) {
  std::ostringstream whole;
  whole << step_prefix() << text;
  if (on_failure == OnFailure::kRaise)
    whole << ". With " << in_language("on_failure=\"return\"", "OnFailure::kReturn")
          << ", what there is comes back with the status of each sample; with "
          << in_language("\"zero_grad\"", "OnFailure::kZeroGrad")
          << " the failed ones have no gradient, and a training goes on";
  TORCH_CHECK_LINALG(on_failure != OnFailure::kRaise, whole.str());
  warning_sink().load()(whole.str());
}

bool should_look(size_t at) {
  static std::mutex mutex;
  static std::unordered_map<size_t, uint64_t> times;
  const std::lock_guard lock(mutex);
  return std::has_single_bit(++times[at]) || c10::WarningUtils::get_warnAlways();
}

bool should_warn_again(const std::string& key, double size) {
  static std::mutex mutex;
  static std::map<std::string, double> said;
  const std::lock_guard lock(mutex);
  const auto [at, is_first] = said.try_emplace(key, size);
  const bool is_worse = !is_first && size > 10.0 * at->second;
  if (is_worse) at->second = size;
  return is_first || is_worse || c10::WarningUtils::get_warnAlways();
}

void warn_this_once(const std::string& text, bool may_get_worse) {
  warning_sink().load()(
      step_prefix() + text +
      (may_get_worse ? ". This is said once, and again if it gets ten times worse" : ". This is said once"));
}

}  // namespace prdp
