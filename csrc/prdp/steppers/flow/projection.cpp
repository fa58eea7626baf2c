#include "prdp/steppers/flow/projection.h"

#include <ATen/TensorSubclassLikeUtils.h>

#include <limits>

#include "prdp/operators/singular_operator.h"
#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/kept_hierarchy.h"
#include "prdp/solvers/prepared_batch.h"
#include "prdp/steppers/flow/explicit_loops.h"
#include "prdp/steppers/flow/projection_loops.h"
#include "prdp/steppers/flow/stencil_of.h"

namespace prdp {

namespace {

/// It knows its null space, in which rounding would leave something of residuals that a method carries on.
OperatorSpec pressure_operator(const FlowBox& box, const at::Tensor& u) {
  const auto& fields = box.fields(u.options());
  auto a = stencil_of(box, fields.pressure);
  return fields.null_vectors.defined() ? with_null_space(std::move(a), fields.null_vectors) : a;
}

/// All solves for the pressure share the coarse grids, and have right-hand sides without_means().
SolveOptions for_pressure(const FlowBox& box, const at::Tensor& b, SolveOptions options) {
  gpu::share_hierarchy(options, b, box.fields(b.options()).coarse_grids);
  options.cotangent_is_in_range = true;
  return options;
}

/// Takes off the mean of each part that `part_of_cell` numbers, in a few operations however many there are.
at::Tensor without_means_of_many(const at::Tensor& t, const at::Tensor& part_of_cell, int64_t count) {
  const auto values = t.flatten(1).to(at::kDouble);
  const auto part = part_of_cell.expand_as(values);
  const auto zeros = at::zeros({values.size(0), count + 1}, values.options());
  const auto sums = zeros.scatter_add(1, part, values), cells = zeros.scatter_add(1, part, at::ones_like(values));
  const auto means = at::cat({zeros.narrow(1, 0, 1), (sums / cells.clamp_min(1)).narrow(1, 1, count)}, 1);
  return (values - means.gather(1, part)).to(t.scalar_type()).view_as(t);
}

/// Takes off the mean of each closed part of the fluid: differences of pressures have none, but for rounding.
at::Tensor without_means(const FlowBox& box, const at::Tensor& t) {
  const auto& parts = box.fields(t.options()).closed_parts;
  if (!parts.defined()) return t;
  const auto flat = t.flatten(2);
  if (parts.numel() == 0) return (flat - mean_in_order(flat, {-1})).view_as(t);
  constexpr int64_t many = 4;
  if (parts.size(1) >= many) return without_means_of_many(t, box.fields(t.options()).part_of_cell, parts.size(1));
  const auto of_parts = parts.flatten(2);
  const auto cells = of_parts.sum(2, /*keepdim=*/true).clamp_min(1);
  return without_parts(flat, of_parts / cells, of_parts).view_as(t);
}

/// Divergences that the dtype has no normal numbers for are rounding, and nothing to do: they are zero to the solve,
/// which could not tell their mean from what rounding leaves of it. Their derivative stays.
at::Tensor flush_subnormals(const at::Tensor& b) {
  const double normal =
      b.scalar_type() == at::kFloat ? std::numeric_limits<float>::min() : std::numeric_limits<double>::min();
  const auto rows = largest_magnitude(b) < normal;
  if (b.is_cpu() && !at::isTensorSubclassLike(b) && !rows.any().item<bool>()) return b;
  return at::where(per_sample(rows, b), b - b.detach(), b);
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

/// u + factor · grad p on the faces that `free` marks with 1; undefined, on all.
at::Tensor add_gradient(const FlowBox& box, const at::Tensor& u, const at::Tensor& p, double factor,
                        const at::Tensor& free) {
  if (flow_has_loops(u)) return add_gradient_by_loops(box, u, p, factor, free);
  return u.add(masked(differences(box, p), free), factor);
}

}  // namespace

// With square cells the coefficients are then whole numbers, and the sums of rows are zero to the last bit in any
// dtype.
double scale_of_pressure(const FlowBox& box) { return box.dx(box.dim() - 1) * box.dx(box.dim() - 1); }

at::Tensor flow_divergence(const FlowBox& box, const at::Tensor& u, double factor) {
  if (flow_kernels::can_run(u)) {
    const auto b = flow_kernels::divergence(box, {.base = u}, factor, /*for_a_solve=*/false);
    if (b.defined()) return b;
  }
  const auto& cells = box.fields(u.options()).cells;
  if (flow_has_loops(u)) return masked(divergence_by_loops(box, u, factor), cells);
  at::Tensor sum;
  for (int64_t axis = 0; axis < box.dim(); ++axis) {
    const auto low = u.select(1, box.channel_of(axis));
    const auto of_axis = (neighbour(box, low, axis, 1, 0.0) - low) * (factor / box.dx(axis));
    sum = sum.defined() ? sum + of_axis : of_axis;
  }
  return masked(sum.unsqueeze(1), cells);
}

std::optional<flow_kernels::Corrected> project_by_kernels(const FlowBox& box, const ProjectionLaunch& by,
                                                          const SolveOptions& options, CombinedInfo& info) {
  const double factor = by.reverse ? 1.0 : -scale_of_pressure(box);
  const auto b = flow_kernels::divergence(box, by.to_project, factor, /*for_a_solve=*/true);
  if (!b.defined()) return std::nullopt;
  const auto a = pressure_operator(box, b);
  const auto o = for_pressure(box, b, options);
  if (!by.reverse) return flow_kernels::correct(box, by.to_correct, counted_solve(a, b, o, info), by.how);
  const auto found = counted_adjoint_solve(a, b, {}, o, info).b;
  auto to_correct = by.to_correct;
  to_correct.status_of_solve = info.last().status;  // the cotangent itself may hold the NaN
  return flow_kernels::correct(box, to_correct, found, by.how);
}

Projected project(const FlowBox& box, const at::Tensor& u, const SolveOptions& options, CombinedInfo& info) {
  const auto& fields = box.fields(u.options());
  const auto b = flush_subnormals(without_means(box, flow_divergence(box, u, -scale_of_pressure(box))));
  // A preconditioner may leave something in the cells of solids.
  const auto found =
      masked(counted_solve(pressure_operator(box, u), b, for_pressure(box, b, options), info), fields.cells);
  const auto phi = without_means(box, found);
  return {add_gradient(box, u, phi, -1.0, fields.free), phi};
}

Projected project_sum(const FlowBox& box, const at::Tensor& u, const FlowParts& added, const at::Tensor& potential,
                      const SolveOptions& options, CombinedInfo& info) {
  const bool by_kernels = flow_kernels::can_run(u);
  if (by_kernels) {
    const flow_kernels::UncorrectedVelocity of{.base = u, .added = added};
    if (const auto found = project_by_kernels(box, {of, of, {.factor = -1.0, .before = potential}}, options, info))
      return {found->u, found->potential};
  }
  auto rest = joined(added);
  if (by_kernels && rest.defined()) rest = masked(rest, box.fields(u.options()).free);
  auto all = project(box, rest.defined() ? u + rest : u, options, info);
  add_to(all.potential, potential);
  return all;
}

ProjectVjp project_vjp(const FlowBox& box, at::Tensor cotangent, at::Tensor potential_bar, const at::Tensor& refused,
                       const SolveOptions& options, CombinedInfo& info) {
  const auto& fields = box.fields(cotangent.options());
  if (flow_kernels::can_run(cotangent)) {
    const flow_kernels::CorrectionOptions how{scale_of_pressure(box), /*on_all_faces=*/true,
                                              /*wants_on_free_faces=*/true};
    const ProjectionLaunch by{{.added = {cotangent}, .potential_bar = potential_bar, .refused = refused},
                              {.base = cotangent, .refused = refused},
                              how,
                              /*reverse=*/true};
    if (const auto found = project_by_kernels(box, by, options, info)) return {found->u, found->on_free_faces};
    const auto to_clear = refused.defined() ? refused.ne(0) : at::Tensor();
    cotangent = cleared(cotangent, to_clear);
    potential_bar = cleared(potential_bar, to_clear);
  }
  auto phi_bar = flow_divergence(box, masked(cotangent, fields.free));
  if (potential_bar.defined()) phi_bar = phi_bar + masked(potential_bar, fields.cells);
  phi_bar = without_means(box, phi_bar);
  // What a potential's cotangent leaves may be its mean and little else. What rounding leaves of the mean counts then.
  if (potential_bar.defined()) phi_bar = without_means(box, phi_bar);
  phi_bar = flush_subnormals(phi_bar);
  const auto a = pressure_operator(box, cotangent);
  const auto b_bar =
      without_means(box, counted_adjoint_solve(a, phi_bar, {}, for_pressure(box, phi_bar, options), info).b);
  const auto u_bar = add_gradient(box, cotangent, masked(b_bar, fields.cells), scale_of_pressure(box), {});
  return {u_bar, masked(u_bar, fields.free)};
}

}  // namespace prdp
