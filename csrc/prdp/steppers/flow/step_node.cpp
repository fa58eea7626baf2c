#include "prdp/steppers/flow/step_node.h"

#include <ATen/core/grad_mode.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/custom_class.h>

#include "prdp/autograd/adjoint_log.h"
#include "prdp/autograd/for_each_cotangent.h"
#include "prdp/error_text.h"
#include "prdp/operators/autocast.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/saved_outputs.h"
#include "prdp/operators/tensors.h"
#include "prdp/steppers/flow/cotangents.h"
#include "prdp/steppers/rollout_loops.h"

namespace prdp {

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

/// What travels from the forward to the backward pass beside tensors.
struct Call : torch::CustomClassHolder {
  FlowEquation equation;
  std::vector<bool> has{};  // which of its tensors the equation has
  int64_t steps;
  FlowOutput output;
  SolveOptions options;
  std::shared_ptr<const RegisteredProducts> products;  // of the preconditioner
  at::Tensor saved_output{};                           // within forward()
};

/// The tensors that the backward pass finds again, in this order.
enum Saved : size_t {
  kState,    // u, or of a rollout all its states
  kStatus,   // undefined where failures raise
  kTensors,  // from here on, those of the equation
};

/// Functions of autograd take no undefined tensors: an empty one stands for none.
std::vector<at::Tensor> or_empty(std::vector<at::Tensor> tensors, const at::Tensor& u) {
  for (auto& t : tensors)
    if (!t.defined()) t = at::empty({0}, u.options());
  return tensors;
}
FlowEquation equation_of(const Call& call, at::TensorList or_empty) {
  auto tensors = or_empty.vec();
  for (size_t i = 0; i < tensors.size(); ++i)
    if (!call.has[i]) tensors[i] = at::Tensor();
  return call.equation.with_tensors(tensors);
}

/// What is asked for, and the reports of the steps.
SolveResult forward_steps(const FlowEquation& equation, const at::Tensor& u, int64_t steps, FlowOutput output,
                          const SolveOptions& options) {
  if (output != FlowOutput::kStates) {
    const auto step = flow_step(equation, u, options);
    return {output_of(step, output, equation.dt), step.info};
  }
  return solve_in_place(u, steps, 1, [&](const at::Tensor& state, int64_t) -> SolveResult {
    auto step = flow_step(equation, state, options);
    return {std::move(step.u), std::move(step.info)};
  });
}

class FlowSteps : public torch::autograd::Function<FlowSteps> {
 public:
  /// `tensors`: those of the equation, empty ones for none.
  static variable_list forward(AutogradContext* ctx, const at::Tensor& u, at::TensorList tensors,
                               const c10::intrusive_ptr<Call>& call) {
    const at::AutoDispatchBelowADInplaceOrView below;
    const auto equation = equation_of(*call, tensors);
    const auto [out, info] = forward_steps(equation, u, call->steps, call->output, call->options);
    ctx->mark_non_differentiable({info.iterations, info.residual, info.status, info.operator_applications, info.floor});
    ctx->set_materialize_grads(false);
    const bool may_have_failed = call->options.on_failure != OnFailure::kRaise;
    variable_list saved{call->output == FlowOutput::kStates ? out : u, may_have_failed ? info.status : at::Tensor()};
    saved.insert(saved.end(), tensors.begin(), tensors.end());
    ctx->save_for_backward(std::move(saved));
    ctx->saved_data["call"] = c10::IValue::make_capsule(call);
    if (call->output == FlowOutput::kStates) call->saved_output = out;
    return {out, info.iterations, info.residual, info.status, info.operator_applications, info.floor};
  }

  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    const auto saved = ctx->get_saved_variables();
    const auto call = c10::static_intrusive_pointer_cast<Call>(ctx->saved_data["call"].toCapsule());
    const auto tensors = at::TensorList(saved).slice(kTensors);
    variable_list out(tensors.size() + 2);
    if (!grads[0].defined()) return out;
    const auto equation = equation_of(*call, tensors);
    std::vector<int64_t> needed(tensors.size() + 1);
    for (size_t i = 0; i < needed.size(); ++i) needed[i] = ctx->needs_input_grad(i);
    const auto of_cotangent = [&](const at::Tensor& cotangent) {
      const auto vjp = call->output == FlowOutput::kStates ? states_vjp : step_vjp;
      return vjp(equation, saved[kState], saved[kStatus], cotangent, *call, needed);
    };
    const WithoutAutocast full_precision;
    const auto found = for_each_cotangent(grads[0], of_cotangent);
    std::copy(found.begin(), found.end(), out.begin());
    return out;
  }

 private:
  static std::vector<at::Tensor> step_vjp(const FlowEquation& equation, const at::Tensor& u, const at::Tensor& status,
                                          const at::Tensor& cotangent, const Call& call, at::IntArrayRef needed) {
    SolveInfo info;
    const auto usable =
        usable_cotangent(cotangent, status, call.output == FlowOutput::kNextAndPressure, call.options.on_failure);
    FlowCotangent of_step{usable.bar};
    if (call.output == FlowOutput::kNextAndPressure) {
      const int64_t d = u.size(1);
      of_step = {of_step.u.narrow(1, 0, d), of_step.u.narrow(1, d, 1) / equation.dt};
    }
    auto found = flow_step_vjp(equation, u, of_step, call.options, needed, info);
    if (call.options.adjoint_log != 0 && info.status.defined())
      adjoint_log::write(call.options.adjoint_log, usable.reported(info));
    return found;
  }

  static std::vector<at::Tensor> states_vjp(const FlowEquation& equation, const at::Tensor& states,
                                            const at::Tensor& status, const at::Tensor& cotangent, const Call& call,
                                            at::IntArrayRef needed) {
    std::vector<at::Tensor> sums(needed.size());
    auto bar = cotangent.select(1, call.steps);
    const auto log = at::GradMode::is_enabled() ? c10::SymInt(0) : call.options.adjoint_log;
    solve_by_solve_back(cotangent, 1, log, [&](int64_t s) {
      const auto status_of_step = status.defined() ? status.select(1, s) : status;
      std::vector<int64_t> wanted = needed.vec();
      wanted[0] = needed[0] || s > 0;
      SolveInfo info;
      const auto usable = usable_cotangent(bar, status_of_step, /*has_pressure=*/false, call.options.on_failure);
      const auto found = flow_step_vjp(equation, states.select(1, s), {usable.bar}, call.options, wanted, info);
      bar = cotangent.select(1, s);
      add_to(bar, found[0]);
      for (size_t i = 1; i < sums.size(); ++i) add_to(sums[i], found[i]);
      return usable.reported(info);
    });
    if (needed[0]) sums[0] = bar;
    return sums;
  }
};

/// With walls whose component through them, which must be 0, gets no gradient.
FlowEquation with_gradients_along_walls(FlowEquation e) {
  for (size_t i = 0; i < e.wall_velocity.size(); ++i) {
    auto& velocity = e.wall_velocity[i];
    if (!velocity.defined() || !velocity.requires_grad()) continue;
    const int64_t channel = velocity.dim() == 1 ? 0 : 1;
    std::vector<int64_t> sizes(velocity.dim(), 1);
    sizes[channel] = e.box->dim();
    auto along = at::ones(sizes, velocity.options().requires_grad(false));
    along.select(channel, e.box->channel_of(static_cast<int64_t>(i) / 2)).zero_();
    velocity = velocity * along;
  }
  return e;
}

}  // namespace

void check_flow_options(const SolveOptions& options) {
  options.check("Flow");
  TORCH_CHECK_VALUE(options.start == Start::kZero, "Flow: start must be ", in_language("'zero'", "Start::kZero"),
                    ": its solves are for changes");
}

at::Tensor output_of(const FlowStep& step, FlowOutput output, double dt) {
  return output == FlowOutput::kNext ? step.u : at::cat({step.u, step.potential / dt}, 1);
}

SolveResult flow_steps(const FlowEquation& equation, const at::Tensor& u, int64_t steps, FlowOutput output,
                       const SolveOptions& options) {
  check_flow_options(options);
  equation.check_steps(u, steps);
  const WithoutAutocast full_precision;
  bool differentiable = at::GradMode::is_enabled() && u.requires_grad();
  for (const auto& t : equation.tensors())
    differentiable = differentiable || (at::GradMode::is_enabled() && t.defined() && t.requires_grad());
  if (!differentiable || options.backward == Backward::kNone) {
    const at::NoGradGuard no_grad;
    return forward_steps(equation, u.detach(), steps, output, options);
  }
  auto call = c10::make_intrusive<Call>();
  const auto given = with_gradients_along_walls(equation).tensors();
  for (const auto& t : given) call->has.push_back(t.defined());
  const auto tensors = or_empty(given, u);
  call->equation = equation.with_tensors(std::vector<at::Tensor>(tensors.size()));
  call->steps = steps;
  call->output = output;
  call->options = options;
  call->products = products_of(options.solver.preconditioner.spec());
  const auto out = apply_with_saved_output<FlowSteps>(call->saved_output, u, at::TensorList(tensors), call);
  return {out[0], {out[1], out[2], out[3], out[4], out[5]}};
}

}  // namespace prdp
