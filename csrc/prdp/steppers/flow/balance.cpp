#include "prdp/steppers/flow/balance.h"

#include <algorithm>

namespace prdp {

namespace {

/// If the whole pressure of the explicit part is taken off, waves beside walls grow from ν dt/dx² = 10 to 16 on, in
/// thin boxes and on long, thin cells. Measured as the spectral radius of steps of Stokes flow.
constexpr double kLargestWhole = 4;

/// Around an island with a throat one cell wide a flow grows too: the pressure passes the drag of the throat on to all
/// the fluid that moves as one. This begins at ν dt Σ 1/dx² = 1.5, summed over the axes across the throat; the longer
/// the way around, the sooner.
constexpr double kLargestWholeOfThroats = 1.25;

bool is_incremental(const FlowEquation& e, const at::Tensor& like) {
  return e.is_diffused_implicitly() && e.pressure == FlowPressure::kIncremental &&
         e.box->fields(like.options()).free.defined();
}

/// The share of this pressure that is taken off, of all samples or of each; undefined: the whole of all.
at::Tensor share_of_pressure(const FlowEquation& e) {
  const double limit = largest_viscosity(e);
  return e.largest_nu() <= limit ? at::Tensor() : limit / e.nu.clamp_min(limit);
}

}  // namespace

double largest_viscosity(const FlowEquation& e) {
  const auto& box = *e.box;
  if (box.obstacle().defined()) {
    // Across the throat are all axes but one, at worst the one with the largest dx.
    const double dx = box.largest_dx(), across = box.sum_of_couplings() / 2 - 1 / (dx * dx);
    return kLargestWholeOfThroats / across / e.dt;
  }
  double least = box.dx(0);
  for (int64_t axis = 1; axis < box.dim(); ++axis) least = std::min(least, box.dx(axis));
  return kLargestWhole * least * least / e.dt;
}

Projected balance(const FlowEquation& e, const at::Tensor& change, const SolveOptions& options, CombinedInfo& info) {
  if (!is_incremental(e, change)) return {change, {}};
  if (flow_kernels::can_run(change)) {
    const double limit = largest_viscosity(e);
    const ProjectionLaunch by{
        {.added = {change}}, {.added = {change}, .share_by_nu = e.nu, .largest_nu = limit}, {.factor = -1.0}};
    if (const auto found = project_by_kernels(*e.box, by, options, info)) return {found->u, found->potential};
  }
  auto whole = project(*e.box, change, options, info);
  const auto share = share_of_pressure(e);
  if (!share.defined()) return whole;
  return {at::lerp(change, whole.u, share), whole.potential * share};
}

namespace {

FlowParts change_back(const FlowEquation& e, const FlowParts& cotangent, const at::Tensor& potential_bar,
                      const SolveOptions& options, CombinedInfo& info) {
  if (flow_kernels::can_run(cotangent[0])) {
    const double limit = largest_viscosity(e);
    const ProjectionLaunch by{
        {.added = cotangent, .potential_bar = potential_bar, .share_by_nu = e.nu, .largest_nu = limit},
        {.added = cotangent},
        {.factor = scale_of_pressure(*e.box)},
        /*reverse=*/true};
    if (const auto found = project_by_kernels(*e.box, by, options, info)) return {found->u};
  }
  const auto& free = e.box->fields(cotangent[0].options()).free;
  const auto given = joined(cotangent) * free;
  const auto share = share_of_pressure(e);
  if (!share.defined()) return {project_vjp(*e.box, given, potential_bar, {}, options, info).on_free_faces};
  const auto of_whole = potential_bar.defined() ? potential_bar * share : potential_bar;
  return {given * (1.0 - share) + project_vjp(*e.box, given * share, of_whole, {}, options, info).on_free_faces};
}

}  // namespace

BalanceVjp balance_vjp(const FlowEquation& e, const FlowParts& cotangent, const at::Tensor& potential_bar,
                       const at::Tensor& change, const SolveOptions& options, CombinedInfo& info) {
  if (!is_incremental(e, cotangent[0])) return {cotangent, {}};
  BalanceVjp found{change_back(e, cotangent, potential_bar, options, info), {}};
  const auto share = share_of_pressure(e);
  if (!change.defined() || !share.defined()) return found;
  CombinedInfo again;
  const auto whole = project(*e.box, change, options, again);
  auto of_share = e.nu_gradient(joined(cotangent) * (whole.u - change));
  if (potential_bar.defined()) of_share = of_share + e.nu_gradient(potential_bar * whole.potential);
  const double limit = largest_viscosity(e);
  found.nu = at::where(e.nu > limit, -of_share * share / e.nu.clamp_min(limit), 0.0);
  return found;
}

}  // namespace prdp
