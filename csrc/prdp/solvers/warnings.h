#pragma once
#include <sstream>
#include <string>
#include <utility>

#include "prdp/solvers/solver.h"

/// How failures and warnings of solves are said: in a rollout with the step, and warnings not twice.
namespace prdp {

/// Sets where warnings go; null: back to torch, which prints them on stderr.
using WarningSink = void (*)(const std::string& text);
void set_warning_sink(WarningSink sink);

/// While it exists, reports on this thread name this step of a rollout, counted from 1.
class FailuresOfStep {
 public:
  FailuresOfStep(int64_t step, int64_t steps);
  FailuresOfStep(const FailuresOfStep&) = delete;
  ~FailuresOfStep();
  /// The step that this thread is in, and the number of steps; 0 and 0 outside of a rollout.
  static std::pair<int64_t, int64_t> now();

 private:
  int64_t step_before_, steps_before_;
};

/// Raises c10::LinAlgError or warns about the failures that `text` names; only for kRaise and kWarn.
void raise_or_warn(const std::string& text, OnFailure on_failure);

/// Whether this is the 1st, 2nd, 4th, 8th, … time for what the number stands for, so that looks cost little however
/// often they are asked for.
bool should_look(size_t at);
/// Whether there has been no warning for this `key`, or only of what is less than a tenth as bad.
bool should_warn_again(const std::string& key, double size);
/// Warns with this text, and says that it will not be said again unless it gets worse.
void warn_this_once(const std::string& text, bool may_get_worse);
/// Warns with what `say` writes, the first time for this `key`, and again where its size is ten times as large; 0:
/// never again.
template <class Say>
void warn_once(const std::string& key, double size, const Say& say) {
  if (!should_warn_again(key, size)) return;
  std::ostringstream text;
  say(text);
  warn_this_once(text.str(), size > 0.0);
}

}  // namespace prdp
