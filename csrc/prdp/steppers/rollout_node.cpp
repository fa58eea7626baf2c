#include "prdp/steppers/rollout_node.h"

#include <torch/csrc/autograd/custom_function.h>
#include <torch/custom_class.h>

#include "prdp/autograd/for_each_cotangent.h"
#include "prdp/operators/autocast.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/saved_outputs.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/kept_hierarchy.h"
#include "prdp/steppers/equation_kinds.h"

namespace prdp {

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

/// What the forward pass hands on to the backward pass beside tensors.
struct Call : torch::CustomClassHolder {
  Equation equation;  // without its tensors, once they are saved
  c10::SymInt solves;
  SolveOptions options;
  std::shared_ptr<const RegisteredProducts> products;  // of the preconditioner
  at::Tensor saved_output{};                           // within forward()
};

/// Unrolled mode differentiates the iterations, and needs all. Implicit mode needs the solutions alone, and those only
/// if A has a derivative. Where a failed sample may have passed, its status says so.
KeptSolves what_is_needed(const SolveOutputs& outputs, bool a_varies, const SolveOptions& options) {
  const auto& [solutions, iterations, residual, status, applications, floor] = outputs;
  KeptSolves kept;
  if (options.backward == Backward::kUnrolled) return {solutions, iterations, status, residual};
  if (a_varies) kept.solutions = solutions;
  if (options.on_failure != OnFailure::kRaise) kept.status = status;
  return kept;
}

class RolloutSolves : public torch::autograd::Function<RolloutSolves> {
 public:
  static variable_list forward(AutogradContext* ctx, const at::Tensor& u, at::TensorList tensors,
                               const c10::intrusive_ptr<Call>& call) {
    const auto outputs = rollout_below_autograd(call->equation, u, call->solves, call->options);
    const bool a_varies = equation_kind(call->equation.kind).linearised || any_requires_grad(tensors);
    ctx->save_for_backward(to_save(what_is_needed(outputs, a_varies, call->options), tensors));
    call->equation.tensors.clear();
    ctx->saved_data["call"] = c10::IValue::make_capsule(call);
    const auto& [solutions, iterations, residual, status, applications, floor] = outputs;
    ctx->mark_non_differentiable({iterations, residual, status, applications, floor});
    ctx->set_materialize_grads(false);
    call->saved_output = solutions;
    return {solutions, iterations, residual, status, applications, floor};
  }

  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    const auto call = c10::static_intrusive_pointer_cast<Call>(ctx->saved_data["call"].toCapsule());
    auto equation = call->equation;
    const auto kept = from_saved(ctx->get_saved_variables(), equation.tensors);
    const size_t inputs = equation.tensors.size() + 1;
    variable_list gradients(inputs + 1);  // u, the tensors, and the call, which has none
    if (!grads[0].defined()) return gradients;
    std::vector<int64_t> needed(inputs);
    for (size_t i = 0; i < inputs; ++i) needed[i] = ctx->needs_input_grad(i);
    const WithoutAutocast full_precision;
    const auto found = for_each_cotangent(
        grads[0], [&](const at::Tensor& cotangent) { return vjp(cotangent, kept, equation, call->options, needed); });
    std::copy(found.begin(), found.end(), gradients.begin());
    return gradients;
  }

 private:
  static variable_list to_save(KeptSolves kept, at::TensorList tensors) {
    variable_list saved;
    for (auto* part : kept.parts()) saved.push_back(std::move(*part));
    saved.insert(saved.end(), tensors.begin(), tensors.end());
    return saved;
  }
  static KeptSolves from_saved(const variable_list& saved, std::vector<at::Tensor>& tensors) {
    KeptSolves kept;
    auto next = saved.begin();
    for (auto* part : kept.parts()) *part = *next++;
    tensors.assign(next, saved.end());
    return kept;
  }

  static variable_list vjp(const at::Tensor& cotangent, const KeptSolves& kept, const Equation& equation,
                           const SolveOptions& options, at::IntArrayRef needed) {
    // With create_graph=True the derivative is itself recorded, solve by solve; else it is one op.
    if (at::GradMode::is_enabled() || has_tangent(cotangent))
      return vjp_of_solves(cotangent, kept, equation, options, needed, linear_solve);
    return in_places(rollout_vjp_below_autograd(cotangent, kept, equation, options, needed), needed);
  }
};

}  // namespace

SolveOutputs record_rollout(const Equation& equation, const at::Tensor& u, const c10::SymInt& solves,
                            const SolveOptions& given) {
  auto options = given;
  if (!equation_kind(equation.kind).linearised && is_plain(u) && !solves.is_symbolic())  // A is that of all steps
    gpu::share_hierarchy(options, u, solves.expect_int());
  const at::TensorList tensors = equation.tensors;
  TORCH_CHECK_NOT_IMPLEMENTED(!has_tangent(u) && !any_tangent(tensors),
                              "rollout_solves: has no forward mode; take the op rollout");
  const bool differentiable = at::GradMode::is_enabled() && options.backward != Backward::kNone &&
                              (u.requires_grad() || any_requires_grad(tensors));
  if (!differentiable) return rollout_below_autograd(equation, u, solves, options);
  auto call = c10::make_intrusive<Call>();
  call->equation = equation;
  call->solves = solves;
  call->options = std::move(options);
  call->products = products_of(call->options.solver.preconditioner.spec());
  const auto out = apply_with_saved_output<RolloutSolves>(call->saved_output, u, tensors, call);
  return {out[0], out[1], out[2], out[3], out[4], out[5]};
}

}  // namespace prdp
