#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/custom_class.h>
#include <torch/library.h>

#include <limits>

#include "prdp/autograd/packed_options.h"
#include "prdp/operators/autocast.h"
#include "prdp/operators/function_operator.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/kept_hierarchy.h"
#include "prdp/solvers/solve.h"
#include "prdp/steppers/equation_kinds.h"
#include "prdp/steppers/memory_check.h"
#include "prdp/steppers/rollout.h"
#include "prdp/steppers/rollout_vjp.h"
#include "prdp/steppers/stepper.h"
#include "prdp/threads/interruption.h"

namespace prdp {

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

// A rollout is a row of solves, picard_steps to a step: solve s takes its winds from solution s and its
// right-hand side from the first solution of its step, and makes solution s + 1. Solution 0 is u.
constexpr const char* kSolvesSchema =
    "rollout_solves(Tensor u, Tensor[] tensors, str kind, int[] shape, float[] parameters, int picard_steps, "
    "SymInt solves, " PRDP_OPTIONS_SCHEMA ") -> (Tensor solutions, " PRDP_REPORT_SCHEMA ")";
constexpr const char* kVjpSchema =
    "rollout_vjp(Tensor cotangent, Tensor? solutions, Tensor? iterations, Tensor? status, "
    "Tensor? residual, int[] needed, Tensor[] tensors, str kind, int[] shape, float[] parameters, int "
    "picard_steps, " PRDP_OPTIONS_SCHEMA ") -> Tensor[]";

using SolvesSignature = WithOptions<SolveOutputs(const at::Tensor&, at::TensorList, c10::string_view, at::IntArrayRef,
                                                 at::ArrayRef<double>, int64_t, c10::SymInt)>;
using VjpSignature = WithOptions<std::vector<at::Tensor>(
    const at::Tensor&, const OptionalTensor&, const OptionalTensor&, const OptionalTensor&, const OptionalTensor&,
    at::IntArrayRef, at::TensorList, c10::string_view, at::IntArrayRef, at::ArrayRef<double>, int64_t)>;

SolveOutputs call_solves(const Equation& e, const at::Tensor& u, const c10::SymInt& solves, const SolveOptions& o) {
  static const auto op =
      c10::Dispatcher::singleton().findSchemaOrThrow("prdp::rollout_solves", "").typed<SolvesSignature>();
  return call_with_options(op, o, u, e.tensors, e.kind, e.shape, e.parameters, e.picard_steps, solves);
}

/// The arguments of an op but u; the forward pass hands them on to the backward pass.
struct Call : torch::CustomClassHolder {
  Equation equation;
  c10::SymInt count;  // of solves; of steps in the op rollout
  SolveOptions options;
  std::shared_ptr<const RegisteredProducts> products{};  // of the preconditioner
};

Equation equation_of(at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                     at::ArrayRef<double> parameters, int64_t picard_steps) {
  return {std::string(kind), shape.vec(), parameters.vec(), tensors.vec(), picard_steps};
}

template <class... Options>
Call unpack_call(at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape, at::ArrayRef<double> parameters,
                 int64_t picard_steps, c10::SymInt solves, const Options&... packed) {
  Call call;
  call.equation = equation_of(tensors, kind, shape, parameters, picard_steps);
  call.count = std::move(solves);
  call.options = unpack(packed...);
  return call;
}

void check(const Equation& equation, const at::Tensor& u, const c10::SymInt& solves, const SolveOptions& options) {
  equation.check_picard_steps();
  options.check(equation.kind.c_str());
  check_memory(options, u);
  TORCH_CHECK_VALUE(solves.is_symbolic() || solves.expect_int() >= 0, "rollout: steps must be >= 0, got ",
                    solves / equation.picard_steps);
  const auto a = equation_operator(equation, u);
  make_operator(a)->check_vector(u);
  check_devices(a, u);
}

SolveOutputs solve_all(const Equation& equation, const at::Tensor& u, const c10::SymInt& solves,
                       const SolveOptions& options) {
  check(equation, u, solves, options);
  const int64_t picard = equation.picard_steps, unknowns = u.numel();
  at::Tensor b;
  return outputs_of(solve_by_solve(u, solves.expect_int(), picard, [&](const at::Tensor& last, int64_t s) {
    interruption::Watch::local().spend(unknowns);
    if (s % picard == 0) b = equation_rhs(equation, last);
    return linear_solve_kernel(equation_operator(equation, last), b, options, start_of_step(options, last));
  }));
}

/// Below autograd.
template <class... Args>
SolveOutputs solves_kernel(const at::Tensor& u, Args... args) {
  const auto call = unpack_call(std::move(args)...);
  return solve_all(call.equation, u, call.count, call.options);
}

template <class... Args>
SolveOutputs fake_solves(const at::Tensor& u, Args... args) {
  const auto call = unpack_call(std::move(args)...);
  check(call.equation, u, call.count, call.options);
  auto sizes = u.sym_sizes().vec();
  sizes.insert(sizes.begin() + 1, call.count + 1);
  return outputs_of({at::empty_symint(sizes, u.options()), fake_info(u, {u.sym_size(0), call.count})});
}

/// The gradients that are needed.
std::vector<at::Tensor> solve_all_back(const at::Tensor& cotangent, const KeptSolves& kept, const Equation& equation,
                                       const SolveOptions& options, at::IntArrayRef needed) {
  const at::NoGradGuard no_grad;
  const auto found = vjp_of_solves(cotangent, kept, equation, options, needed, linear_solve_kernel);
  std::vector<at::Tensor> gradients;
  for (size_t i = 0; i < found.size(); ++i) {
    if (!needed[i]) continue;
    gradients.push_back(!found[i].defined() ? at::zeros_like(equation.tensors[i - 1])
                        : i == 0            ? found[i].contiguous()
                                            : found[i]);
  }
  return gradients;
}

template <class... Options>
std::vector<at::Tensor> vjp_kernel(const at::Tensor& cotangent, const OptionalTensor& solutions,
                                   const OptionalTensor& iterations, const OptionalTensor& status,
                                   const OptionalTensor& residual, at::IntArrayRef needed, at::TensorList tensors,
                                   c10::string_view kind, at::IntArrayRef shape, at::ArrayRef<double> parameters,
                                   int64_t picard_steps, Options... packed) {
  const auto equation = equation_of(tensors, kind, shape, parameters, picard_steps);
  equation.check_picard_steps();
  const KeptSolves kept{solutions.value_or(at::Tensor()), iterations.value_or(at::Tensor()),
                        status.value_or(at::Tensor()), residual.value_or(at::Tensor())};
  return solve_all_back(cotangent, kept, equation, unpack(packed...), needed);
}

template <class... Options>
std::vector<at::Tensor> fake_vjp(const at::Tensor& cotangent, const OptionalTensor&, const OptionalTensor&,
                                 const OptionalTensor&, const OptionalTensor&, at::IntArrayRef needed,
                                 at::TensorList tensors, c10::string_view, at::IntArrayRef, at::ArrayRef<double>,
                                 int64_t, Options...) {
  std::vector<at::Tensor> gradients;
  auto sizes = cotangent.sym_sizes().vec();
  sizes.erase(sizes.begin() + 1);
  if (needed[0]) gradients.push_back(at::empty_symint(sizes, cotangent.options()));
  for (size_t i = 0; i < tensors.size(); ++i)
    if (needed[i + 1]) gradients.push_back(at::empty_symint(tensors[i].sym_sizes(), tensors[i].options()));
  return gradients;
}

std::vector<at::Tensor> call_solves_back(const at::Tensor& cotangent, const KeptSolves& kept, const Equation& e,
                                         const SolveOptions& o, at::IntArrayRef needed) {
  static const auto op = c10::Dispatcher::singleton().findSchemaOrThrow("prdp::rollout_vjp", "").typed<VjpSignature>();
  return call_with_options(op, o, cotangent, or_none(kept.solutions), or_none(kept.iterations), or_none(kept.status),
                           or_none(kept.residual), needed, e.tensors, e.kind, e.shape, e.parameters, e.picard_steps);
}

/// Whether all tensors of a call are plain. Then it need not cross the dispatcher, which takes longer than a small
/// solve.
bool is_plain_call(const Equation& e, const at::Tensor& v, const SolveOptions& o) {
  return is_plain(v) && all_plain(e.tensors) && all_plain(o.solver.preconditioner.spec().tensors);
}

/// The op below autograd.
SolveOutputs call_below(const Equation& e, const at::Tensor& u, const c10::SymInt& solves, const SolveOptions& o) {
  const at::AutoDispatchBelowADInplaceOrView below;
  return is_plain_call(e, u, o) ? solve_all(e, u, solves, o) : call_solves(e, u, solves, o);
}

class RolloutSolves : public torch::autograd::Function<RolloutSolves> {
 public:
  static variable_list forward(AutogradContext* ctx, const at::Tensor& u, at::TensorList tensors,
                               const c10::intrusive_ptr<Call>& call) {
    const auto& options = call->options;
    auto outputs = call_below(call->equation, u, call->count, options);
    const auto& [solutions, iterations, residual, status, applications, floor] = outputs;
    ctx->mark_non_differentiable({iterations, residual, status, applications, floor});
    ctx->set_materialize_grads(false);
    const bool unrolled = options.backward == Backward::kUnrolled;
    const bool a_varies = equation_kind(call->equation.kind).linearised || any_requires_grad(tensors);
    const bool may_have_failed = options.on_failure != OnFailure::kRaise;
    variable_list saved{unrolled || a_varies ? solutions : at::Tensor(), unrolled ? iterations : at::Tensor(),
                        unrolled || may_have_failed ? status : at::Tensor(), unrolled ? residual : at::Tensor()};
    saved.insert(saved.end(), tensors.begin(), tensors.end());
    ctx->save_for_backward(saved);
    call->equation.tensors.clear();  // they are among the saved ones
    ctx->saved_data["call"] = c10::IValue::make_capsule(call);
    return {solutions, iterations, residual, status, applications, floor};
  }

  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    const auto saved = ctx->get_saved_variables();
    const auto call = c10::static_intrusive_pointer_cast<Call>(ctx->saved_data["call"].toCapsule());
    auto equation = call->equation;
    equation.tensors.assign(saved.begin() + 4, saved.end());
    const size_t inputs = equation.tensors.size() + 1;
    variable_list out(inputs + 1);  // u, the tensors, and the call, which has no gradient
    if (!grads[0].defined()) return out;
    std::vector<int64_t> needed(inputs);
    for (size_t i = 0; i < inputs; ++i) needed[i] = ctx->needs_input_grad(i);
    const KeptSolves kept{saved[0], saved[1], saved[2], saved[3]};
    const auto gradients = [&](const at::Tensor& cotangent) {
      return vjp(cotangent, kept, equation, call->options, needed);
    };
    const WithoutAutocast full_precision;
    const auto found = is_batch_of_cotangents(grads[0]) ? for_each_cotangent(grads[0], gradients) : gradients(grads[0]);
    std::copy(found.begin(), found.end(), out.begin());
    return out;
  }

 private:
  static variable_list vjp(const at::Tensor& cotangent, const KeptSolves& kept, const Equation& equation,
                           const SolveOptions& options, at::IntArrayRef needed) {
    // With create_graph=True the derivative is itself recorded, solve by solve; else it is one op.
    if (at::GradMode::is_enabled() || has_tangent(cotangent))
      return vjp_of_solves(cotangent, kept, equation, options, needed, linear_solve);
    const auto back = is_plain_call(equation, cotangent, options) ? solve_all_back : call_solves_back;
    const auto found = back(cotangent, kept, equation, options, needed);
    variable_list gradients(needed.size());
    for (size_t i = 0, next = 0; i < needed.size(); ++i)
      if (needed[i]) gradients[i] = found[next++];
    return gradients;
  }
};

/// The op's autograd kernel.
SolveOutputs solve_and_record(const Equation& equation, const at::Tensor& u, const c10::SymInt& solves,
                              const SolveOptions& options) {
  auto call = c10::make_intrusive<Call>();
  call->equation = equation;
  call->count = solves;
  call->options = options;
  const auto tensors = call->equation.tensors;
  TORCH_CHECK_NOT_IMPLEMENTED(!has_tangent(u) && !any_tangent(tensors),
                              "rollout_solves: has no forward mode; take the op rollout");
  call->products = products_of(call->options.solver.preconditioner.spec());
  if (!equation_kind(equation.kind).linearised && is_plain(u) && !solves.is_symbolic())  // A is that of all steps
    gpu::share_hierarchy(call->options, u, solves.expect_int());
  const bool differentiable = at::GradMode::is_enabled() && call->options.backward != Backward::kNone &&
                              (u.requires_grad() || any_requires_grad(tensors));
  if (!differentiable) return call_below(call->equation, u, call->count, call->options);
  const auto out = RolloutSolves::apply(u, at::TensorList(tensors), call);
  return {out[0], out[1], out[2], out[3], out[4], out[5]};
}

template <class... Args>
SolveOutputs autograd_solves(const at::Tensor& u, Args... args) {
  const auto call = unpack_call(std::move(args)...);
  return solve_and_record(call.equation, u, call.count, call.options);
}

/// The same step by step.
SolveResult chain(const Equation& equation, const at::Tensor& u, int64_t steps, SolveOptions options) {
  check(equation, u, steps * equation.picard_steps, options);
  options.adjoint_log = 0;  // it would hold the first step's alone
  return solve_by_solve(u, steps, 1, [&](const at::Tensor& state, int64_t) { return step(equation, state, options); });
}

template <class... Args>
SolveOutputs rollout_kernel(const at::Tensor& u, Args... args) {
  const auto call = unpack_call(std::move(args)...);
  return outputs_of(rollout(call.equation, u, call.count, call.options));
}

}  // namespace

SolveResult rollout(const Equation& equation, const at::Tensor& u, const c10::SymInt& steps,
                    const SolveOptions& options) {
  // The one op has neither forward mode nor transforms; its steps have.
  if (in_torch_func() || has_tangent(u) || any_tangent(equation.tensors))
    return chain(equation, u, steps.expect_int(), options);
  const int64_t picard = equation.picard_steps;
  TORCH_CHECK_VALUE(
      steps.is_symbolic() || picard < 1 || steps.expect_int() <= std::numeric_limits<int64_t>::max() / picard,
      "rollout: steps times picard_steps must be below 2^63, got ", steps, " times ", picard);
  const auto solve = no_mode_is_on() && is_plain_call(equation, u, options) ? solve_and_record : call_solves;
  auto [solutions, info] = result_of(solve(equation, u, steps * picard, options));
  if (picard == 1) return {solutions, info};
  const auto of_steps = [&](const at::Tensor& t) { return t.unflatten_symint(1, {steps, picard}); };
  const auto last = [&](const at::Tensor& t) { return of_steps(t).select(-1, picard - 1); };
  const auto worst = of_steps(info.status).amin(-1);
  return {solutions.slice_symint(1, 0, std::nullopt, picard),
          {of_steps(info.iterations).sum(-1), last(info.residual), worst, of_steps(info.operator_applications).sum(-1),
           floor_of(last(info.floor), worst)}};
}

TORCH_LIBRARY_FRAGMENT(prdp, m) {
  m.def(kSolvesSchema, {at::Tag::pt2_compliant_tag});
  m.def(kVjpSchema, {at::Tag::pt2_compliant_tag});
  m.def(
      "rollout(Tensor u, Tensor[] tensors, str kind, int[] shape, float[] parameters, int picard_steps, "
      "SymInt steps, " PRDP_OPTIONS_SCHEMA ") -> (Tensor states, " PRDP_REPORT_SCHEMA ")",
      static_cast<SolvesSignature*>(rollout_kernel));
}
TORCH_LIBRARY_IMPL(prdp, CompositeExplicitAutograd, m) {
  m.impl("rollout_solves", static_cast<SolvesSignature*>(solves_kernel));
  m.impl("rollout_vjp", static_cast<VjpSignature*>(vjp_kernel));
}
TORCH_LIBRARY_IMPL(prdp, Meta, m) {
  m.impl("rollout_solves", static_cast<SolvesSignature*>(fake_solves));
  m.impl("rollout_vjp", static_cast<VjpSignature*>(fake_vjp));
}
TORCH_LIBRARY_IMPL(prdp, Autograd, m) { m.impl("rollout_solves", static_cast<SolvesSignature*>(autograd_solves)); }

TORCH_LIBRARY_IMPL(prdp, FuncTorchBatchedDecomposition, m) {
  m.impl("rollout", static_cast<SolvesSignature*>(rollout_kernel));
}

}  // namespace prdp
