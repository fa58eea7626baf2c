#include "prdp/steppers/flow/balance.h"

namespace prdp {

namespace {

/// With the whole pressure of the explicit part, waves beside walls grow from a ν dt/dx² of 10 to 16 on, in thin boxes
/// and on cells that are long and thin. Measured as the spectral radius of steps of Stokes flow.
constexpr double kLargestWhole = 4;

bool is_incremental(const FlowEquation& e) {
  return e.diffusion == FlowDiffusion::kImplicit && e.pressure == FlowPressure::kIncremental &&
         e.box->fields(e.nu.options()).free.defined();
}

/// The largest ν for which the whole pressure is taken off.
double largest_viscosity(const FlowEquation& e) {
  double least = e.box->dx(0);
  for (int64_t axis = 1; axis < e.box->dim(); ++axis) least = std::min(least, e.box->dx(axis));
  return kLargestWhole * least * least / e.dt;
}

}  // namespace

Projected balance(const FlowEquation& e, const at::Tensor& change, const SolveOptions& options, CombinedInfo& info) {
  if (!is_incremental(e)) return {change, {}};
  auto whole = project(*e.box, change, options, info);
  const double limit = largest_viscosity(e);
  if (e.nu.item<double>() <= limit) return whole;
  const auto share = limit / e.nu;
  return {at::lerp(change, whole.u, share), whole.potential * share};
}

BalanceVjp balance_vjp(const FlowEquation& e, const at::Tensor& cotangent, const at::Tensor& of_potential,
                       const at::Tensor& change, const SolveOptions& options, CombinedInfo& info) {
  if (!is_incremental(e)) return {cotangent, {}};
  const auto& free = e.box->fields(cotangent.options()).free;
  const double limit = largest_viscosity(e);
  if (e.nu.item<double>() <= limit)
    return {project_vjp(*e.box, cotangent * free, of_potential, options, info) * free, {}};
  const auto share = limit / e.nu;
  const auto of_whole = of_potential.defined() ? of_potential * share : of_potential;
  const auto through = project_vjp(*e.box, cotangent * free * share, of_whole, options, info) * free;
  BalanceVjp found{cotangent * free * (1.0 - share) + through, {}};
  if (!change.defined()) return found;
  CombinedInfo again;
  const auto whole = project(*e.box, change, options, again);
  auto of_share = (cotangent * (whole.u - change)).sum();
  if (of_potential.defined()) of_share = of_share + (of_potential * whole.potential).sum();
  found.nu = -of_share * share / e.nu;
  return found;
}

}  // namespace prdp
