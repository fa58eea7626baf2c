#include "prdp/steppers/flow/projection.h"

#include "prdp/steppers/flow/stencil_of.h"

namespace prdp {

namespace {

/// -div grad of the pressure, and its null space.
OperatorSpec pressure_operator(const FlowBox& box, const at::Tensor& u) {
  const auto& fields = box.fields(u.options());
  auto a = stencil_of(box, fields.pressure);
  if (!fields.closed_parts.defined()) return a;
  a.kind = "singular_" + a.kind;
  a.tensors.insert(a.tensors.end(), {fields.closed_parts, fields.closed_parts});
  return a;
}

at::Tensor masked(const at::Tensor& t, const at::Tensor& mask) { return mask.defined() ? t * mask : t; }

/// The differences of p on all faces; p is zero beyond the ends of axes that are not periodic.
at::Tensor differences(const FlowBox& box, const at::Tensor& p) {
  std::vector<at::Tensor> components(box.dim());
  const auto q = p.select(1, 0);
  for (int64_t axis = 0; axis < box.dim(); ++axis)
    components[box.channel_of(axis)] = (q - neighbour(box, q, axis, -1, 0.0)) * (1.0 / box.dx(axis));
  return at::stack(components, 1);
}

}  // namespace

at::Tensor flow_divergence(const FlowBox& box, const at::Tensor& u) {
  at::Tensor sum;
  for (int64_t axis = 0; axis < box.dim(); ++axis) {
    const auto low = u.select(1, box.channel_of(axis));
    const auto of_axis = (neighbour(box, low, axis, 1, 0.0) - low) * (1.0 / box.dx(axis));
    sum = sum.defined() ? sum + of_axis : of_axis;
  }
  return masked(sum.unsqueeze(1), box.fields(u.options()).cells);
}

at::Tensor flow_gradient(const FlowBox& box, const at::Tensor& p) {
  return masked(differences(box, p), box.fields(p.options()).free);
}

Projected project(const FlowBox& box, const at::Tensor& u, const SolveOptions& options, CombinedInfo& info) {
  const auto phi = solve(pressure_operator(box, u), -flow_divergence(box, u), options, info);
  return {u - flow_gradient(box, phi), phi};
}

at::Tensor project_vjp(const FlowBox& box, const at::Tensor& cotangent, const SolveOptions& options,
                       CombinedInfo& info) {
  const auto& fields = box.fields(cotangent.options());
  const auto phi_bar = flow_divergence(box, masked(cotangent, fields.free));
  const auto b_bar = solve_vjp(pressure_operator(box, cotangent), phi_bar, {}, options, info).b;
  return cotangent + differences(box, masked(b_bar, fields.cells));
}

}  // namespace prdp
