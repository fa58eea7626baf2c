#include "prdp/controller/controller.h"

#include <c10/util/Exception.h>

#include <cmath>
#include <iomanip>
#include <sstream>

namespace prdp {

namespace {

/// Below it, solves are as good as converged.
constexpr double kSmallResidual = 1e-4;
/// The residual may make up the error from this share on. Measured: up to .28 trainings end as well as with
/// converged solves, from .38 on most do not (docs/refinement.md).
constexpr double kShareOfError = 0.3;
/// Too large for whatever the metric may be.
constexpr double kLargeResidual = 0.1;

}  // namespace

std::optional<std::string> Controller::warning() const {
  const auto& history = state().history;
  if (history.empty() || !history.back().residual) return {};
  const auto& last = history.back();
  const double residual = *last.residual;
  if (residual <= kSmallResidual) return {};
  std::ostringstream text;
  text << std::scientific << std::setprecision(1) << name() << ": the solves stop at a residual of " << residual
       << " (K = " << last.max_iter << "), ";
  if (last.error) {
    // The residual is relative to a state that holds the error as well.
    if (residual <= kShareOfError * *last.error / (1.0 + *last.error)) return {};
    text << "too far off for an error of " << *last.error << ": what is trained may have taken up the solver's error";
  } else {
    if (residual <= kLargeResidual || !stalled()) return {};
    text << "and the metric no longer falls: what is trained may have taken up the solver's error";
  }
  text << "; " << remedy();
  return text.str();
}

int64_t adjoint_share(const char* who, double ratio, int64_t max_iter) {
  TORCH_CHECK_VALUE(ratio > 0.0 && ratio <= 1.0, who, ": adjoint_ratio must be > 0 and <= 1, got ", ratio);
  return static_cast<int64_t>(std::ceil(ratio * static_cast<double>(max_iter) - 1e-9));
}

}  // namespace prdp
