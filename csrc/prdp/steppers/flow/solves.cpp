#include "prdp/steppers/flow/solves.h"

#include "prdp/operators/disguises.h"

namespace prdp {

namespace {

/// Takes the mean of each closed part of the fluid off: no difference of pressures has one.
at::Tensor without_means(const FlowBox& box, const at::Tensor& t) {
  const auto& fields = box.fields(t.options());
  const auto flat = t.flatten(2);
  if (!fields.part.defined()) return (flat - flat.mean(2, /*keepdim=*/true)).view_as(t);
  const auto& counts = fields.cells_of_parts;
  const auto none = at::zeros({t.size(0), t.size(1), counts.size(0)}, t.options());
  auto means = none.index_add(2, fields.part, flat) / counts.clamp_min(1);
  means = at::cat({means.narrow(2, 0, counts.size(0) - 1), none.narrow(2, 0, 1)}, 2);  // not of what has a level
  return (flat - means.index_select(2, fields.part)).view_as(t);
}

}  // namespace

void CombinedInfo::add(const SolveInfo& info) {
  if (!info_.status.defined()) {
    info_ = info;
    return;
  }
  const auto solved = info_.solved().logical_and(info.solved());
  info_.iterations = info_.iterations + info.iterations;
  info_.residual = at::maximum(info_.residual, info.residual);
  info_.status = at::minimum(info_.status, info.status);  // the least is the worst
  info_.operator_applications = info_.operator_applications + info.operator_applications;
  info_.floor = at::maximum(info_.floor, info.floor) * solved;
}

at::Tensor solve(const FlowBox& box, const FlowSystem& system, const at::Tensor& b, CombinedInfo& info) {
  const auto rhs = system.singular ? without_means(box, b) : b;
  auto result = linear_solve(system.a, rhs, system.options);
  info.add(result.info);
  return system.singular ? without_means(box, result.u) : result.u;
}

SystemVjp solve_vjp(const FlowBox& box, const FlowSystem& system, const at::Tensor& cotangent, const at::Tensor& u,
                    CombinedInfo& info) {
  const auto bar = system.singular ? without_means(box, cotangent) : cotangent;
  const auto found = implicit_vjp(bar, u, system.a, system.options, {1, u.defined()}, linear_solve_kernel);
  info.add(found.info);
  const auto& b = found.gradients[0];
  return {system.singular ? without_means(box, b) : b, found.gradients[1]};
}

}  // namespace prdp
