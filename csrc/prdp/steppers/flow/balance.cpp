#include "prdp/steppers/flow/balance.h"

#include <limits>

#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

bool is_incremental(const FlowEquation& e, const at::Tensor& like) {
  return e.is_diffused_implicitly() && e.pressure == FlowPressure::kIncremental &&
         e.box->fields(like.options()).free.defined();
}

/// The share of this pressure that is taken off, of all samples or of each, and its derivative with respect to ν;
/// undefined: the whole of all.
struct Share {
  at::Tensor value, by_nu;
};
Share share_of_pressure(const FlowEquation& e, const at::Tensor& like) {
  const auto [limit, limits] = largest_viscosity(e, like);
  if (!limits.defined()) {
    if (e.largest_nu() <= limit) return {};
    const auto value = limit / e.nu.clamp_min(limit);
    return {value, at::where(e.nu > limit, -value / e.nu.clamp_min(limit), 0.0)};
  }
  if (e.largest_nu() <= limits.min().item<double>()) return {};
  const auto of_samples = per_sample(limits.to(like.options()), like), larger = at::maximum(e.nu, of_samples);
  const auto value = of_samples / larger;
  return {value, at::where(e.nu > of_samples, -value / larger, 0.0)};
}

}  // namespace

LargestViscosity largest_viscosity(const FlowEquation& e, const at::Tensor& like) {
  constexpr double most = std::numeric_limits<float>::max();
  const auto& fields = e.box->fields(like.options());
  const auto& of_each = fields.largest_diffusions;
  return {fields.largest_diffusion / e.dt, of_each.defined() ? (of_each / e.dt).clamp_max(most) : at::Tensor()};
}

Projected balance(const FlowEquation& e, const at::Tensor& change, const SolveOptions& options, CombinedInfo& info) {
  if (!is_incremental(e, change)) return {change, {}};
  if (flow_kernels::can_run(change)) {
    const ProjectionLaunch by{{.added = {change}},
                              {.added = {change}, .share_by_nu = e.nu, .largest_nu = largest_viscosity(e, change)},
                              {.factor = -1.0}};
    if (const auto found = project_by_kernels(*e.box, by, options, info)) return {found->u, found->potential};
  }
  auto whole = project(*e.box, change, options, info);
  const auto share = share_of_pressure(e, change).value;
  if (!share.defined()) return whole;
  return {at::lerp(change, whole.u, share), whole.potential * share};
}

namespace {

FlowParts change_back(const FlowEquation& e, const FlowParts& cotangent, const at::Tensor& potential_bar,
                      const SolveOptions& options, CombinedInfo& info) {
  if (flow_kernels::can_run(cotangent[0])) {
    const ProjectionLaunch by{{.added = cotangent,
                               .potential_bar = potential_bar,
                               .share_by_nu = e.nu,
                               .largest_nu = largest_viscosity(e, cotangent[0])},
                              {.added = cotangent},
                              {.factor = scale_of_pressure(*e.box)},
                              /*reverse=*/true};
    if (const auto found = project_by_kernels(*e.box, by, options, info)) return {found->u};
  }
  const auto& free = e.box->fields(cotangent[0].options()).free;
  const auto given = joined(cotangent) * free;
  const auto share = share_of_pressure(e, given).value;
  if (!share.defined()) return {project_vjp(*e.box, given, potential_bar, {}, options, info).on_free_faces};
  const auto of_whole = potential_bar.defined() ? potential_bar * share : potential_bar;
  return {given * (1.0 - share) + project_vjp(*e.box, given * share, of_whole, {}, options, info).on_free_faces};
}

}  // namespace

BalanceVjp balance_vjp(const FlowEquation& e, const FlowParts& cotangent, const at::Tensor& potential_bar,
                       const at::Tensor& change, const SolveOptions& options, CombinedInfo& info) {
  if (!is_incremental(e, cotangent[0])) return {cotangent, {}};
  BalanceVjp found{change_back(e, cotangent, potential_bar, options, info), {}};
  const auto share = share_of_pressure(e, cotangent[0]);
  if (!change.defined() || !share.value.defined()) return found;
  CombinedInfo again;
  const auto whole = project(*e.box, change, options, again);
  found.nu = e.nu_gradient(joined(cotangent) * (whole.u - change) * share.by_nu);
  if (potential_bar.defined()) found.nu = found.nu + e.nu_gradient(potential_bar * whole.potential * share.by_nu);
  return found;
}

}  // namespace prdp
