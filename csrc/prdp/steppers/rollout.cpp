#include "prdp/steppers/rollout.h"

#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/custom_class.h>
#include <torch/library.h>

#include "prdp/autograd/adjoint_log.h"
#include "prdp/autograd/flat_options.h"
#include "prdp/autograd/solve_vjp.h"

namespace prdp {

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;
using Outputs = std::tuple<at::Tensor, at::Tensor, at::Tensor, at::Tensor, at::Tensor>;

// A rollout is a row of solves, picard_steps to a step: solve s takes its winds from solution s and its
// right-hand side from the first solution of its step, and makes solution s + 1. Solution 0 is u.
constexpr const char* kSolvesSchema =
    "rollout_solves(Tensor u, Tensor[] tensors, str kind, int[] shape, float[] parameters, int picard_steps, "
    "SymInt solves, " PRDP_OPTIONS_SCHEMA ") -> "
    "(Tensor solutions, Tensor iterations, Tensor residual, Tensor status, Tensor operator_applications)";
constexpr const char* kVjpSchema =
    "rollout_vjp(Tensor cotangent, Tensor? solutions, Tensor? iterations, Tensor? status, int[] needed, "
    "Tensor[] tensors, str kind, int[] shape, float[] parameters, int picard_steps, " PRDP_OPTIONS_SCHEMA
    ") -> Tensor[]";

using SolvesSignature = WithOptions<Outputs(const at::Tensor&, at::TensorList, c10::string_view, at::IntArrayRef,
                                            at::ArrayRef<double>, int64_t, c10::SymInt)>;
using OptionalTensor = std::optional<at::Tensor>;
using VjpSignature = WithOptions<std::vector<at::Tensor>(
    const at::Tensor&, const OptionalTensor&, const OptionalTensor&, const OptionalTensor&, at::IntArrayRef,
    at::TensorList, c10::string_view, at::IntArrayRef, at::ArrayRef<double>, int64_t)>;

Outputs call_solves(const Equation& e, const at::Tensor& u, const c10::SymInt& solves, const SolveOptions& o) {
  static const auto op = c10::Dispatcher::singleton()
                             .findSchemaOrThrow("prdp::rollout_solves", "")
                             .typed<SolvesSignature>();
  return call_with_options(op, o, u, at::TensorList(e.tensors), c10::string_view(e.kind), at::IntArrayRef(e.shape),
                           at::ArrayRef<double>(e.parameters), e.picard_steps, solves);
}

Equation equation_of(at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                     at::ArrayRef<double> parameters, int64_t picard_steps) {
  return {std::string(kind), shape.vec(), parameters.vec(), tensors.vec(), picard_steps};
}

void check(const Equation& equation, const at::Tensor& u, const c10::SymInt& solves, const SolveOptions& options) {
  options.check(equation.kind.c_str());
  TORCH_CHECK_VALUE(solves.is_symbolic() || solves.expect_int() >= 0, "rollout: steps must be >= 0, got ",
                    solves / equation.picard_steps);
  make_operator(equation_operator(equation, u))->check_vector(u);
}

/// (batch,) of each solve → (batch, solves).
at::Tensor side_by_side(const std::vector<at::Tensor>& of_solves, const at::Tensor& u, at::ScalarType dtype) {
  if (of_solves.empty()) return at::empty({u.size(0), 0}, u.options().dtype(dtype));
  return at::stack(of_solves, 1);
}

/// SolveInfo of the solves, one after the other.
struct Reports {
  std::vector<at::Tensor> iterations, residual, status, applications;

  void push(const SolveInfo& info) {
    iterations.push_back(info.iterations);
    residual.push_back(info.residual);
    status.push_back(info.status);
    applications.push_back(info.operator_applications);
  }
  void reverse() {
    for (auto* list : {&iterations, &residual, &status, &applications}) std::reverse(list->begin(), list->end());
  }
  SolveInfo joined(const at::Tensor& u) const {
    return {side_by_side(iterations, u, at::kLong), side_by_side(residual, u, u.scalar_type()),
            side_by_side(status, u, at::kLong), side_by_side(applications, u, at::kLong)};
  }
};

/// Below autograd.
template <class... Options>
Outputs solves_kernel(const at::Tensor& u, at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                      at::ArrayRef<double> parameters, int64_t picard_steps, c10::SymInt count,
                      Options... flat) {
  const auto equation = equation_of(tensors, kind, shape, parameters, picard_steps);
  const auto options = unflatten(std::move(flat)...);
  check(equation, u, count, options);
  const int64_t solves = count.expect_int();
  std::vector<at::Tensor> solutions{u};
  Reports reports;
  at::Tensor b;
  for (int64_t s = 0; s < solves; ++s) {
    const FailuresOfStep here(s / picard_steps + 1, solves / picard_steps);
    const auto& last = solutions.back();
    if (s % picard_steps == 0) b = equation_rhs(equation, last);
    auto [next, info] = linear_solve_kernel(equation_operator(equation, last), b, options);
    solutions.push_back(std::move(next));
    reports.push(info);
  }
  auto info = reports.joined(u);
  return {at::stack(solutions, 1), info.iterations, info.residual, info.status, info.operator_applications};
}

template <class... Options>
Outputs fake_solves(const at::Tensor& u, at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                    at::ArrayRef<double> parameters, int64_t picard_steps, c10::SymInt solves,
                    Options... flat) {
  check(equation_of(tensors, kind, shape, parameters, picard_steps), u, solves, unflatten(std::move(flat)...));
  auto sizes = u.sym_sizes().vec();
  sizes.insert(sizes.begin() + 1, solves + 1);
  const auto of_dtype = [&](at::ScalarType dtype) {
    return at::empty_symint({u.sym_size(0), solves}, u.options().dtype(dtype));
  };
  return {at::empty_symint(sizes, u.options()), of_dtype(at::kLong), of_dtype(u.scalar_type()),
          of_dtype(at::kLong), of_dtype(at::kLong)};
}

/// What the solves keep for their derivative; undefined where it is not wanted.
struct Kept {
  at::Tensor solutions, iterations, status;  // (batch, solves (+ 1), …)
};

at::Tensor at_solve(const at::Tensor& of_solves, int64_t s) {
  return of_solves.defined() ? of_solves.select(1, s) : of_solves;
}

void add_to(at::Tensor& sum, const at::Tensor& term) {
  if (term.defined()) sum = sum.defined() ? sum + term : term;
}

/// Gradients of u and of each tensor for the cotangent of all solutions, undefined where `needed` (u
/// first) holds 0. Sums run in the order in which autograd takes the steps of a chain.
std::vector<at::Tensor> reverse(const at::Tensor& cotangent, const Kept& kept, const Equation& equation,
                                const SolveOptions& options, at::IntArrayRef needed,
                                decltype(linear_solve)& adjoint_solve) {
  const int64_t solves = cotangent.size(1) - 1, picard = equation.picard_steps;
  const bool rhs_is_state = equation.kind == "heat" || equation.kind == "burgers";
  const bool flow = is_flow(equation);
  auto each = options;
  each.adjoint_log = 0;
  auto bars = cotangent.unbind(1);
  std::vector<at::Tensor> of_tensors(equation.tensors.size());
  Reports reports;
  at::Tensor rhs_bar;
  for (int64_t s = solves - 1; s >= 0; --s) {
    const FailuresOfStep here(s / picard + 1, solves / picard);
    const int64_t first = s - s % picard;
    const auto a = equation_operator(equation, at_solve(kept.solutions, s));
    Solved solved{{}, at_solve(kept.solutions, s + 1), at_solve(kept.iterations, s), at_solve(kept.status, s)};
    if (options.backward == Backward::kUnrolled)
      solved.b = equation_rhs(equation, at_solve(kept.solutions, first));
    std::vector<int64_t> wanted(needed.begin(), needed.end());
    wanted[0] = needed[0] || first > 0;
    if (flow) wanted.insert(wanted.begin() + 1, needed[0] || s > 0);
    const auto [gradients, info] = solve_vjp(bars[s + 1], solved, a, each, wanted, adjoint_solve);
    reports.push(info);
    add_to(rhs_is_state ? bars[first] : rhs_bar, gradients[0]);
    if (flow) add_to(bars[s], gradients[1]);
    if (s == first && rhs_bar.defined()) {
      add_to(bars[s], equation_rhs_transposed(equation, rhs_bar));
      rhs_bar = at::Tensor();
    }
    for (size_t i = 0; i < of_tensors.size(); ++i) add_to(of_tensors[i], gradients[gradients.size() - of_tensors.size() + i]);
  }
  reports.reverse();
  if (options.adjoint_log != 0) adjoint_log::write(options.adjoint_log, reports.joined(cotangent));
  std::vector<at::Tensor> found{needed[0] ? bars[0] : at::Tensor()};
  found.insert(found.end(), of_tensors.begin(), of_tensors.end());
  return found;
}

template <class... Options>
std::vector<at::Tensor> vjp_kernel(const at::Tensor& cotangent, const OptionalTensor& solutions,
                                   const OptionalTensor& iterations, const OptionalTensor& status,
                                   at::IntArrayRef needed, at::TensorList tensors, c10::string_view kind,
                                   at::IntArrayRef shape, at::ArrayRef<double> parameters, int64_t picard_steps,
                                   Options... flat) {
  const at::NoGradGuard no_grad;
  const auto equation = equation_of(tensors, kind, shape, parameters, picard_steps);
  const Kept kept{solutions.value_or(at::Tensor()), iterations.value_or(at::Tensor()),
                  status.value_or(at::Tensor())};
  const auto found = reverse(cotangent, kept, equation, unflatten(std::move(flat)...), needed, linear_solve_kernel);
  std::vector<at::Tensor> gradients;
  for (size_t i = 0; i < found.size(); ++i) {
    if (!needed[i]) continue;
    gradients.push_back(!found[i].defined() ? at::zeros_like(tensors[i - 1])
                        : i == 0            ? found[i].contiguous()
                                            : found[i]);
  }
  return gradients;
}

template <class... Options>
std::vector<at::Tensor> fake_vjp(const at::Tensor& cotangent, const OptionalTensor&, const OptionalTensor&,
                                 const OptionalTensor&, at::IntArrayRef needed, at::TensorList tensors,
                                 c10::string_view, at::IntArrayRef, at::ArrayRef<double>, int64_t, Options...) {
  std::vector<at::Tensor> gradients;
  auto sizes = cotangent.sym_sizes().vec();
  sizes.erase(sizes.begin() + 1);
  if (needed[0]) gradients.push_back(at::empty_symint(sizes, cotangent.options()));
  for (size_t i = 0; i < tensors.size(); ++i)
    if (needed[i + 1]) gradients.push_back(at::empty_symint(tensors[i].sym_sizes(), tensors[i].options()));
  return gradients;
}

/// What travels from the forward to the backward pass.
struct Call : torch::CustomClassHolder {
  Equation equation;
  c10::SymInt solves;
  SolveOptions options;
};

class RolloutSolves : public torch::autograd::Function<RolloutSolves> {
 public:
  static variable_list forward(AutogradContext* ctx, const at::Tensor& u, at::TensorList tensors,
                               const c10::intrusive_ptr<Call>& call) {
    const at::AutoDispatchBelowADInplaceOrView below;
    const auto& options = call->options;
    const auto [solutions, iterations, residual, status, applications] =
        call_solves(call->equation, u, call->solves, options);
    ctx->mark_non_differentiable({iterations, residual, status, applications});
    ctx->set_materialize_grads(false);
    const bool unrolled = options.backward == Backward::kUnrolled;
    const bool a_varies = is_flow(call->equation) || std::any_of(tensors.begin(), tensors.end(), [](const at::Tensor& t) {
      return t.requires_grad();
    });
    const bool may_have_failed = options.on_failure != OnFailure::kRaise;
    variable_list saved{unrolled || a_varies ? solutions : at::Tensor(), unrolled ? iterations : at::Tensor(),
                        unrolled || may_have_failed ? status : at::Tensor()};
    saved.insert(saved.end(), tensors.begin(), tensors.end());
    ctx->save_for_backward(saved);
    auto kept = c10::make_intrusive<Call>(*call);
    kept->equation.tensors.clear();
    ctx->saved_data["call"] = c10::IValue::make_capsule(kept);
    return {solutions, iterations, residual, status, applications};
  }

  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    const auto saved = ctx->get_saved_variables();
    const auto call = c10::static_intrusive_pointer_cast<Call>(ctx->saved_data["call"].toCapsule());
    auto equation = call->equation;
    equation.tensors.assign(saved.begin() + 3, saved.end());
    const size_t inputs = equation.tensors.size() + 1;
    variable_list out(inputs + 1);  // u, the tensors, and the call, which has no gradient
    if (!grads[0].defined()) return out;
    std::vector<int64_t> needed(inputs);
    for (size_t i = 0; i < inputs; ++i) needed[i] = ctx->needs_input_grad(i);

    // With create_graph=True the derivative is itself recorded, solve by solve; else it is one op.
    if (at::GradMode::is_enabled()) {
      const auto found = reverse(grads[0], {saved[0], saved[1], saved[2]}, equation, call->options, needed, linear_solve);
      std::copy(found.begin(), found.end(), out.begin());
      return out;
    }
    const auto optional = [](const at::Tensor& t) { return t.defined() ? OptionalTensor(t) : std::nullopt; };
    static const auto op = c10::Dispatcher::singleton()
                               .findSchemaOrThrow("prdp::rollout_vjp", "")
                               .typed<VjpSignature>();
    const auto found = call_with_options(
        op, call->options, grads[0], optional(saved[0]), optional(saved[1]), optional(saved[2]),
        at::IntArrayRef(needed), at::TensorList(equation.tensors), c10::string_view(equation.kind),
        at::IntArrayRef(equation.shape), at::ArrayRef<double>(equation.parameters), equation.picard_steps);
    size_t next = 0;
    for (size_t i = 0; i < inputs; ++i)
      if (needed[i]) out[i] = found[next++];
    return out;
  }
};

template <class... Options>
Outputs autograd_solves(const at::Tensor& u, at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                        at::ArrayRef<double> parameters, int64_t picard_steps, c10::SymInt solves,
                        Options... flat) {
  auto call = c10::make_intrusive<Call>();
  call->equation = equation_of(tensors, kind, shape, parameters, picard_steps);
  call->solves = std::move(solves);
  call->options = unflatten(std::move(flat)...);
  const bool differentiable =
      at::GradMode::is_enabled() && call->options.backward != Backward::kNone &&
      (u.requires_grad() || std::any_of(tensors.begin(), tensors.end(),
                                        [](const at::Tensor& t) { return t.requires_grad(); }));
  if (!differentiable) {
    const at::AutoDispatchBelowADInplaceOrView below;
    return call_solves(call->equation, u, call->solves, call->options);
  }
  const auto out = RolloutSolves::apply(u, at::TensorList(call->equation.tensors), call);
  return {out[0], out[1], out[2], out[3], out[4]};
}

template <class... Options>
Outputs rollout_kernel(const at::Tensor& u, at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                       at::ArrayRef<double> parameters, int64_t picard_steps, c10::SymInt steps,
                       Options... flat) {
  const auto [states, info] = rollout(equation_of(tensors, kind, shape, parameters, picard_steps), u, steps,
                                      unflatten(std::move(flat)...));
  return {states, info.iterations, info.residual, info.status, info.operator_applications};
}

}  // namespace

SolveResult rollout(const Equation& equation, const at::Tensor& u, const c10::SymInt& steps,
                    const SolveOptions& options) {
  const int64_t picard = equation.picard_steps;
  auto [solutions, iterations, residual, status, applications] =
      call_solves(equation, u, steps * picard, options);
  if (picard == 1) return {solutions, {iterations, residual, status, applications}};
  const auto of_steps = [&](const at::Tensor& t) { return t.unflatten_symint(1, {steps, picard}); };
  return {solutions.slice_symint(1, 0, std::nullopt, picard),
          {of_steps(iterations).sum(-1), of_steps(residual).select(-1, picard - 1),
           of_steps(status).amin(-1), of_steps(applications).sum(-1)}};
}

TORCH_LIBRARY_FRAGMENT(prdp, m) {
  m.def(kSolvesSchema, {at::Tag::pt2_compliant_tag});
  m.def(kVjpSchema, {at::Tag::pt2_compliant_tag});
  m.def("rollout(Tensor u, Tensor[] tensors, str kind, int[] shape, float[] parameters, int picard_steps, "
        "SymInt steps, " PRDP_OPTIONS_SCHEMA ") -> (Tensor states, Tensor iterations, Tensor residual, "
        "Tensor status, Tensor operator_applications)",
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

}  // namespace prdp
