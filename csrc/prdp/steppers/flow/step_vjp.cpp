#include <ATen/core/grad_mode.h>
#include <torch/csrc/autograd/autograd.h>

#include "prdp/operators/tensors.h"
#include "prdp/steppers/flow/balance.h"
#include "prdp/steppers/flow/diffusion.h"
#include "prdp/steppers/flow/explicit_loops.h"
#include "prdp/steppers/flow/explicit_part.h"
#include "prdp/steppers/flow/projection.h"
#include "prdp/steppers/flow/step.h"
#include "prdp/steppers/flow/tendency.h"

namespace prdp {

namespace {

/// Tensors to differentiate for. Where autograd records, they stay connected to what they came from.
at::Tensor input_of(const at::Tensor& t, bool needed) {
  if (!t.defined() || !needed) return t;
  return at::GradMode::is_enabled() && t.requires_grad() ? t.alias() : t.detach().requires_grad_();
}

/// grad() of torch, for the inputs that are needed.
std::vector<at::Tensor> gradients(std::vector<at::Tensor> outputs, std::vector<at::Tensor> cotangents,
                                  const std::vector<at::Tensor>& inputs, at::IntArrayRef needed, bool create_graph) {
  std::vector<at::Tensor> of, bars, wanted;
  for (size_t i = 0; i < outputs.size(); ++i)
    if (outputs[i].defined() && outputs[i].requires_grad() && cotangents[i].defined()) {
      of.push_back(outputs[i]);
      bars.push_back(cotangents[i]);
    }
  for (size_t i = 0; i < inputs.size(); ++i)
    if (needed[i]) wanted.push_back(inputs[i]);
  std::vector<at::Tensor> all(inputs.size());
  if (of.empty() || wanted.empty()) return all;
  const auto found = torch::autograd::grad(of, wanted, bars, create_graph, create_graph, /*allow_unused=*/true);
  for (size_t i = 0, next = 0; i < inputs.size(); ++i)
    if (needed[i]) all[i] = found[next++];
  return all;
}

/// The gradients of a step by recording it and differentiating what was recorded; for derivatives of derivatives.
std::vector<at::Tensor> recorded_vjp(const FlowEquation& equation, const at::Tensor& u, const FlowCotangent& cotangent,
                                     SolveOptions options, at::IntArrayRef needed) {
  options.adjoint_log = 0;  // the solves are nodes of their own here: each would log itself as the whole step
  const auto given = equation.tensors();
  std::vector<at::Tensor> inputs{input_of(u, needed[0])};
  for (size_t i = 0; i < given.size(); ++i) inputs.push_back(input_of(given[i], needed[i + 1]));
  const auto step =
      flow_step(equation.with_tensors(at::TensorList(inputs).slice(1)), inputs[0], options, /*reported=*/false);
  return gradients({step.u, step.potential}, {cotangent.u, cotangent.potential}, inputs, needed, /*create_graph=*/true);
}

/// The gradients of u and the tensors of the equation from the cotangents of the velocity with its boundary values, of
/// its change, and of ν in the diffusion.
std::vector<at::Tensor> explicit_vjp_by_autograd(const FlowEquation& equation, const at::Tensor& u,
                                                 const at::Tensor& refused, const at::Tensor& velocity_bar,
                                                 const DiffuseVjp& back, at::IntArrayRef needed) {
  const at::AutoGradMode record(true);
  std::vector<at::Tensor> inputs{u.detach().requires_grad_()};
  const auto given = equation.tensors();
  for (size_t i = 0; i < given.size(); ++i)
    inputs.push_back(given[i].defined() ? given[i].detach().requires_grad_(needed[i + 1]) : given[i]);
  const auto e = equation.with_tensors(at::TensorList(inputs).slice(1)).for_state(u);
  const auto part = explicit_part_of(e, with_boundary_values(e, inputs[0]), refused);
  return gradients({part.velocity, part.change, e.nu}, {velocity_bar, joined(back.change), back.nu}, inputs, needed,
                   /*create_graph=*/false);
}

/// Those that are needed, of the sizes and options of what they belong to.
std::vector<at::Tensor> as_given(const FlowEquation& equation, std::vector<at::Tensor> all, at::IntArrayRef needed) {
  const auto given = equation.tensors();
  for (size_t i = 0; i < all.size(); ++i) {
    if (!needed[i]) all[i] = at::Tensor();
    else if (i > 0 && all[i].defined()) all[i] = all[i].reshape(given[i - 1].sizes()).to(given[i - 1].options());
  }
  return all;
}

/// explicit_vjp_by_autograd() by the loops of the CPU.
std::vector<at::Tensor> explicit_vjp_by_loops(const FlowEquation& equation, const at::Tensor& u,
                                              const at::Tensor& refused, const at::Tensor& velocity_bar,
                                              const DiffuseVjp& back, at::IntArrayRef needed) {
  const auto e = without_boundary_of(equation.for_state(u), refused);
  const auto velocity = cleared(with_boundary_values(e, u), refused);
  auto found = tendency_vjp(e, velocity, joined(back.change) * e.dt);
  add_to(found.nu, back.nu);
  auto of_boundary = boundary_values_vjp(e, velocity_bar + found.u);
  add_to(of_boundary.inflow, found.inflow);
  // u, and then as FlowEquation::Tensor has them
  std::vector<at::Tensor> all{cleared(of_boundary.u, refused), found.nu, found.force, of_boundary.inflow};
  all.insert(all.end(), found.wall_velocity.begin(), found.wall_velocity.end());
  return as_given(equation, std::move(all), needed);
}

/// The way back through the diffusion and the balance; of an explicit diffusion, there is none.
struct ImplicitBack {
  const FlowEquation& e;
  const at::Tensor &diffused_bar, &potential_bar;
  const SolveOptions& options;
  std::vector<OperatorSpec> operators{};
  flow_kernels::ImplicitPart part{};

  ImplicitBack(const FlowEquation& equation, const at::Tensor& bar_of_diffused, const at::Tensor& bar_of_potential,
               const SolveOptions& o)
      : e(equation), diffused_bar(bar_of_diffused), potential_bar(bar_of_potential), options(o) {
    if (e.is_diffused_implicitly()) operators = diffusion_operators(e, diffused_bar);
  }

  /// Balances and diffuses again: the gradient of ν needs what came of it.
  void run_forward(const at::Tensor& change) {
    CombinedInfo not_reported;
    const auto balanced = balance(e, change, options, not_reported);
    part = {.change = change,
            .balanced = balanced.u,
            .potential = balanced.potential,
            .diffused = diffuse(e, operators, balanced.u, options, not_reported),
            .potential_bar = potential_bar,
            .largest_nu = largest_viscosity(e)};
  }
  bool has_run_forward() const { return part.change.defined(); }

  /// The cotangents of the change and, with `with_nu`, of ν, for which run_forward() comes first.
  DiffuseVjp to_change(bool with_nu, CombinedInfo& info) {
    if (!e.is_diffused_implicitly()) return {{diffused_bar}, {}};
    auto found = diffuse_vjp(e, operators, diffused_bar, with_nu ? joined(part.diffused) : at::Tensor(), options, info);
    part.lambda = found.change;  // explicit_vjp() by kernels reads it
    auto balanced = balance_vjp(e, found.change, potential_bar, with_nu ? part.change : at::Tensor(), options, info);
    add_to(balanced.nu, found.nu);
    return {balanced.change, balanced.nu};
  }
};

/// Back through the explicit part: by kernels, which add the share of ν in `implicit`, by the loops of the CPU, or by
/// autograd. `bar`: what implicit.to_change() gave, with the share of ν where there are no kernels.
std::vector<at::Tensor> explicit_vjp(const FlowEquation& equation, const at::Tensor& u, const Beginning& beginning,
                                     const at::Tensor& velocity_bar, ImplicitBack& implicit, DiffuseVjp bar,
                                     at::IntArrayRef needed) {
  if (!beginning.of_kernels) {
    const auto by_loops_or_autograd = flow_has_loops(u) ? explicit_vjp_by_loops : explicit_vjp_by_autograd;
    return by_loops_or_autograd(equation, u, beginning.refused.mask, velocity_bar, bar, needed);
  }
  auto found =
      flow_kernels::explicit_vjp(implicit.e, *beginning.of_kernels, velocity_bar, bar.change, implicit.part, needed);
  if (found) return as_given(equation, *std::move(found), needed);
  if (implicit.has_run_forward()) {  // no kernel could be made: the same adjoint solve again, now with the share of ν
    CombinedInfo counted_before;
    bar = implicit.to_change(/*with_nu=*/true, counted_before);
  }
  return explicit_vjp_by_autograd(equation, u, beginning.of_kernels->status.ne(0), velocity_bar, bar, needed);
}

}  // namespace

std::vector<at::Tensor> flow_step_vjp(const FlowEquation& equation, const at::Tensor& u, const FlowCotangent& cotangent,
                                      const SolveOptions& options, at::IntArrayRef needed, SolveInfo& info) {
  if (at::GradMode::is_enabled()) return recorded_vjp(equation, u, cotangent, options, needed);
  const auto e = equation.for_state(u);
  const auto beginning = begin_step(e, u, /*host_looks=*/false);
  const auto to_clear = beginning.to_clear();
  CombinedInfo adjoint;
  const auto potential_bar = cleared(cotangent.potential, to_clear);
  const auto velocity_bar =
      project_vjp(*e.box, cleared(cotangent.u, to_clear), potential_bar, beginning.status(), options, adjoint);
  ImplicitBack implicit(e, velocity_bar.on_free_faces, potential_bar, options);
  const bool needs_nu = needed[1 + FlowEquation::kNu] != 0;  // u is first
  if (needs_nu && e.is_diffused_implicitly()) implicit.run_forward(explicit_part(e, beginning).change);
  const bool with_nu = implicit.has_run_forward() && !beginning.of_kernels;  // kernels add its share themselves
  const auto bar = implicit.to_change(with_nu, adjoint);
  info = adjoint.info();
  return explicit_vjp(equation, u, beginning, velocity_bar.u, implicit, bar, needed);
}

}  // namespace prdp
