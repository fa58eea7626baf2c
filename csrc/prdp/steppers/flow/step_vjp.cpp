#include <ATen/core/grad_mode.h>

#include "prdp/operators/tensors.h"
#include "prdp/operators/with_autograd.h"
#include "prdp/steppers/flow/balance.h"
#include "prdp/steppers/flow/diffusion.h"
#include "prdp/steppers/flow/explicit_loops.h"
#include "prdp/steppers/flow/explicit_part.h"
#include "prdp/steppers/flow/projection.h"
#include "prdp/steppers/flow/step.h"
#include "prdp/steppers/flow/tendency.h"

namespace prdp {

namespace {

/// An input of what is recorded, which requires a gradient if it is `needed`. Where autograd records the reverse, too,
/// it stays connected to what it came from.
at::Tensor input_of(const at::Tensor& t, bool needed) {
  if (!t.defined() || !needed) return t;
  return at::GradMode::is_enabled() && t.requires_grad() ? t.alias() : t.detach().requires_grad_();
}

/// The gradients of a step by recording it and differentiating what was recorded. This is slower than the way below,
/// but has derivatives itself.
std::vector<at::Tensor> recorded_vjp(const FlowEquation& equation, const at::Tensor& u, const FlowCotangent& cotangent,
                                     SolveOptions options, at::IntArrayRef needed) {
  options.adjoint_log = 0;  // the solves are nodes of their own here: each would log itself as the whole step
  const auto given = equation.tensors();
  std::vector<at::Tensor> inputs{input_of(u, needed[0])};
  for (size_t i = 0; i < given.size(); ++i) inputs.push_back(input_of(given[i], needed[i + 1]));
  const auto step =
      flow_step(equation.with_tensors(at::TensorList(inputs).slice(1)), inputs[0], options, /*reported=*/false);
  return gradients_of({step.u, step.potential}, {cotangent.u, cotangent.potential}, inputs, needed,
                      /*create_graph=*/true);
}

/// Of the gradients of u and the tensors of the equation, those that are needed, in the shape, dtype and device of what
/// the caller gave: the step has its tensors with all axes, as for_state() makes them.
std::vector<at::Tensor> as_given(const FlowEquation& equation, std::vector<at::Tensor> all, at::IntArrayRef needed) {
  const auto given = equation.tensors();
  for (size_t i = 0; i < all.size(); ++i) {
    if (!needed[i]) all[i] = at::Tensor();
    else if (i > 0 && all[i].defined()) all[i] = all[i].reshape(given[i - 1].sizes()).to(given[i - 1].options());
  }
  return all;
}

/// The reverse of what follows the explicit part of a step: the balance by a pressure and the implicit diffusion. Where
/// the diffusion is explicit, there is neither. The calls come in this order:
///
///   1. run_forward(), where the gradient of ν is needed, which depends on what came of the forward pass: before
///      change_bar() with `with_nu`, and before kernels that add the share of ν themselves, as they read part();
///   2. change_bar(), which also completes part().
class ImplicitReverse {
 public:
  /// Of the equation for_state(). `diffused_bar`, `potential_bar`: the cotangents of what the step projects, and of its
  /// potential. All must outlive it.
  ImplicitReverse(const FlowEquation& e, const at::Tensor& diffused_bar, const at::Tensor& potential_bar,
                  const SolveOptions& options)
      : e_(e), diffused_bar_(diffused_bar), potential_bar_(potential_bar), options_(options) {
    if (e_.is_diffused_implicitly()) operators_ = diffusion_operators(e_, diffused_bar_);
  }

  /// Balances and diffuses the change of the explicit part again: the forward pass keeps none of it.
  void run_forward(const at::Tensor& change) {
    CombinedInfo not_reported;
    const auto balanced = balance(e_, change, options_, not_reported);
    part_ = {.change = change,
             .balanced = balanced.u,
             .potential = balanced.potential,
             .diffused = diffuse(e_, operators_, balanced.u, options_, not_reported),
             .potential_bar = potential_bar_,
             .largest_nu = largest_viscosity(e_, change)};
  }
  bool has_run_forward() const { return part_.change.defined(); }

  /// The cotangent of the change by the explicit part and, `with_nu`, the share that diffusion and balance have in that
  /// of ν. By adjoint solves.
  DiffuseVjp change_bar(bool with_nu, CombinedInfo& info) {
    if (!e_.is_diffused_implicitly()) return {{diffused_bar_}, {}};
    const auto diffused = with_nu ? joined(part_.diffused) : at::Tensor();
    auto found = diffuse_vjp(e_, operators_, diffused_bar_, diffused, options_, info);
    part_.lambda = found.change;
    auto balanced =
        balance_vjp(e_, found.change, potential_bar_, with_nu ? part_.change : at::Tensor(), options_, info);
    add_to(balanced.nu, found.nu);
    return {balanced.change, balanced.nu};
  }

  const FlowEquation& equation() const { return e_; }
  const flow_kernels::ImplicitPart& part() const { return part_; }

 private:
  const FlowEquation& e_;
  const at::Tensor &diffused_bar_, &potential_bar_;
  const SolveOptions& options_;
  std::vector<OperatorSpec> operators_{};
  flow_kernels::ImplicitPart part_{};
};

// Three roads back through the explicit part. Each gives the gradients of u and the tensors of the equation from the
// cotangents of the velocity that it starts from, and of its change, with the share of ν in what followed.

/// By the loops of the CPU.
std::vector<at::Tensor> explicit_vjp_by_loops(const FlowEquation& equation, const at::Tensor& u,
                                              const at::Tensor& refused, const at::Tensor& velocity_bar,
                                              const DiffuseVjp& bar, at::IntArrayRef needed) {
  const auto e = without_boundary_of(equation.for_state(u), refused);
  const auto velocity = cleared(with_boundary_values(e, u), refused);
  auto found = tendency_vjp(e, velocity, joined(bar.change) * e.dt);
  add_to(found.nu, bar.nu);
  auto of_boundary = boundary_values_vjp(e, velocity_bar + found.u);
  add_to(of_boundary.inflow, found.inflow);
  // u, and then as FlowEquation::Tensor has them
  std::vector<at::Tensor> all{cleared(of_boundary.u, refused), found.nu, found.force, of_boundary.inflow};
  all.insert(all.end(), found.wall_velocity.begin(), found.wall_velocity.end());
  return as_given(equation, std::move(all), needed);
}

/// By recording the explicit part alone: for devices that have neither loops nor kernels.
std::vector<at::Tensor> explicit_vjp_by_autograd(const FlowEquation& equation, const at::Tensor& u,
                                                 const at::Tensor& refused, const at::Tensor& velocity_bar,
                                                 const DiffuseVjp& bar, at::IntArrayRef needed) {
  const at::AutoGradMode record(true);
  std::vector<at::Tensor> inputs{u.detach().requires_grad_()};
  const auto given = equation.tensors();
  for (size_t i = 0; i < given.size(); ++i)
    inputs.push_back(given[i].defined() ? given[i].detach().requires_grad_(needed[i + 1]) : given[i]);
  const auto e = equation.with_tensors(at::TensorList(inputs).slice(1)).for_state(u);
  const auto part = explicit_part_without_kernels(e, with_boundary_values(e, inputs[0]), refused);
  return gradients_of({part.velocity, part.change, e.nu}, {velocity_bar, joined(bar.change), bar.nu}, inputs, needed);
}

/// In one launch on a GPU, which adds the share of ν itself: `bar` comes without it.
std::vector<at::Tensor> explicit_vjp_by_kernels(const FlowEquation& equation, const at::Tensor& u,
                                                const flow_kernels::PaddedVelocity& start,
                                                const at::Tensor& velocity_bar, ImplicitReverse& implicit,
                                                DiffuseVjp bar, at::IntArrayRef needed) {
  auto found =
      flow_kernels::explicit_vjp(implicit.equation(), start, velocity_bar, bar.change, implicit.part(), needed);
  if (found) return as_given(equation, *std::move(found), needed);
  // No kernel could be made.
  if (implicit.has_run_forward()) {  // the same adjoint solves again, now with the share of ν
    CombinedInfo counted_before;
    bar = implicit.change_bar(/*with_nu=*/true, counted_before);
  }
  return explicit_vjp_by_autograd(equation, u, start.status.ne(0), velocity_bar, bar, needed);
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
  ImplicitReverse implicit(e, velocity_bar.on_free_faces, potential_bar, options);
  const bool needs_nu = needed[1 + FlowEquation::kNu] != 0;  // u is first
  if (needs_nu && e.is_diffused_implicitly()) implicit.run_forward(explicit_part(e, beginning).change);
  // Kernels add the share of ν themselves.
  const bool with_nu = implicit.has_run_forward() && !beginning.of_kernels;
  const auto bar = implicit.change_bar(with_nu, adjoint);
  info = adjoint.info();
  if (beginning.of_kernels)
    return explicit_vjp_by_kernels(equation, u, *beginning.of_kernels, velocity_bar.u, implicit, bar, needed);
  if (flow_has_loops(u)) return explicit_vjp_by_loops(equation, u, beginning.refused.mask, velocity_bar.u, bar, needed);
  return explicit_vjp_by_autograd(equation, u, beginning.refused.mask, velocity_bar.u, bar, needed);
}

}  // namespace prdp
