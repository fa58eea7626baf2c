#include "prdp/steppers/flow/limits.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>
#include <cmath>

#include "prdp/error_text.h"
#include "prdp/operators/operator.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/status.h"
#include "prdp/solvers/warnings.h"
#include "prdp/steppers/flow/tendency.h"

namespace prdp {

namespace {

/// The largest that the Courant number of each sample may be.
std::vector<double> courant_limits(const FlowEquation& e, int64_t samples) {
  auto numbers = to_host<double>(e.nu, samples);
  for (double& nu : numbers) nu = courant_limit(e).at(nu);
  return numbers;
}

/// Says what is not finite in sample i: the inflow (before u, which holds its values), the force, a wall, or u.
std::string nonfinite_part(const FlowEquation& e, const at::Tensor& u, int64_t i) {
  const auto said = [](const std::string& name, const at::Tensor& bad) {
    return c10::str(name, " is not finite at index ", as_tuple(first_true(bad)));
  };
  std::vector<std::pair<std::string, at::Tensor>> given{{"inflow", e.inflow}, {"force", e.force}};
  for (size_t k = 0; k < e.wall_velocity.size(); ++k)
    if (const auto& t = e.wall_velocity[k]; t.defined())
      given.emplace_back(name_of_wall(k), t.squeeze(2 + static_cast<int64_t>(k) / 2));
  for (const auto& [name, t] : given) {
    if (!t.defined()) continue;
    const auto bad = nonfinite(t.select(0, t.size(0) == 1 ? 0 : i));
    if (bad.any().item<bool>()) return said(name, bad);
  }
  return said("the velocity", nonfinite(u[i]));
}

/// What may have made the velocity so large: central advection lets waves grow in explicit Euler. Else empty.
std::string growth_of_waves(const FlowEquation& e, const at::Tensor& u, int64_t sample) {
  const auto of_sample = u[sample].detach();
  const double square = of_sample.square().sum(0).max().item<double>();
  const double longest = 2 * to_host<double>(e.nu, u.size(0))[sample] / square;
  if (e.advection != FlowAdvection::kCentral || !(longest < e.dt)) return {};
  return "; with central advection waves grow where dt > 2 nu/|u|², here " + three_digits(longest);
}

}  // namespace

gpu::CourantLimit courant_limit(const FlowEquation& e) {
  const bool is_upwind = e.advection == FlowAdvection::kUpwind;
  if (!e.is_diffused_implicitly()) return {.taken_per_nu = is_upwind ? e.dt * e.box->sum_of_couplings() : 0.0};
  const double dx = e.box->largest_dx();
  return {.free_per_nu = is_upwind ? 0.0 : 2 * e.dt / (dx * dx)};
}

RefusedSamples find_refused(const FlowEquation& equation, const at::Tensor& u) {
  const at::NoGradGuard no_grad;
  const auto courant = courant_numbers(equation, u);
  auto finite = at::ones_like(courant, at::kBool);  // the force and the walls; the inflow is in u
  auto given = equation.wall_velocity;
  given.push_back(equation.force);
  for (const auto& t : given)
    if (t.defined()) finite = finite.logical_and(t.isfinite().flatten(1).all(1));
  const auto largest = at::tensor(courant_limits(equation, u.size(0)), at::kDouble).to(courant.options());
  const auto fine = courant.le(largest).logical_and_(courant.isfinite()).logical_and_(finite);
  if (fine.all().item<bool>()) return {};
  finite = finite.logical_and(u.isfinite().flatten(1).all(1));  // of a finite u, too, dt Σ |u|/dx may overflow
  const auto diverged = at::full_like(courant, static_cast<double>(SolveStatus::kDiverged)).to(at::kLong);
  return {fine.logical_not(),
          diverged.masked_fill(finite.logical_not(), static_cast<int64_t>(SolveStatus::kNonfiniteInput))};
}

RefusedSamples refused_by(const at::Tensor& status) {
  const auto mask = status.ne(0);
  return mask.any().item<bool>() ? RefusedSamples{mask, status} : RefusedSamples{};
}

void report_refused(const FlowEquation& equation, const at::Tensor& u, const RefusedSamples& refused,
                    OnFailure on_failure) {
  if (on_failure == OnFailure::kReturn || on_failure == OnFailure::kZeroGrad) return;
  const auto courant = courant_numbers(equation, u);
  std::ostringstream text;
  const auto largest = courant_limits(equation, u.size(0));
  const auto failed = refused.mask.nonzero().flatten();
  text << "Flow: " << failed.size(0) << " of " << u.size(0) << " samples failed";
  for (int64_t k = 0; k < std::min<int64_t>(failed.size(0), 4); ++k) {
    const auto i = failed[k].item<int64_t>();
    const auto status = static_cast<SolveStatus>(refused.status[i].item<int64_t>());
    text << (k ? "; " : ": ") << "sample " << i << " " << name(status);
    if (status == SolveStatus::kNonfiniteInput) text << ": " << nonfinite_part(equation, u, i);
    else
      text << ": dt Σ |u|/dx is " << courant[i].item<double>() << ", and the explicit advection needs at most "
           << largest[i] << "; take a smaller dt" << growth_of_waves(equation, u, i);
  }
  raise_or_warn(text.str(), on_failure);
}

}  // namespace prdp
