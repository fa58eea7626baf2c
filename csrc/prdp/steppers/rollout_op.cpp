#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/library.h>

#include <algorithm>
#include <limits>

#include "prdp/operators/kinds.h"
#include "prdp/solvers/memory_check.h"
#include "prdp/solvers/solve.h"
#include "prdp/steppers/packed_equation.h"
#include "prdp/steppers/rollout.h"
#include "prdp/steppers/rollout_loops.h"
#include "prdp/steppers/rollout_node.h"
#include "prdp/steppers/stepper.h"

namespace prdp {

namespace {

constexpr const char* kSolvesSchema =
    "rollout_solves(Tensor u, " PRDP_EQUATION_SCHEMA ", SymInt solves, " PRDP_OPTIONS_SCHEMA
    ") -> (Tensor solutions, " PRDP_REPORT_SCHEMA ")";
constexpr const char* kVjpSchema =
    "rollout_vjp(Tensor cotangent, Tensor? solutions, Tensor? iterations, Tensor? status, Tensor? residual, "
    "int[] needed, " PRDP_EQUATION_SCHEMA ", " PRDP_OPTIONS_SCHEMA ") -> Tensor[]";
constexpr const char* kRolloutSchema = "rollout(Tensor u, " PRDP_EQUATION_SCHEMA ", SymInt steps, " PRDP_OPTIONS_SCHEMA
                                       ") -> (Tensor states, " PRDP_REPORT_SCHEMA ")";

using SolvesSignature = WithOptions<WithEquation<SolveOutputs(const at::Tensor&), c10::SymInt>>;  // of rollout, too
using VjpSignature =
    WithOptions<WithEquation<std::vector<at::Tensor>(const at::Tensor&, const OptionalTensor&, const OptionalTensor&,
                                                     const OptionalTensor&, const OptionalTensor&, at::IntArrayRef)>>;

SolveOutputs call_solves(const Equation& e, const at::Tensor& u, const c10::SymInt& solves, const SolveOptions& o) {
  static const auto op =
      c10::Dispatcher::singleton().findSchemaOrThrow("prdp::rollout_solves", "").typed<SolvesSignature>();
  return call_with_options(op, o, u, e.tensors, e.kind, e.shape, e.parameters, e.picard_steps, solves);
}

void check_rollout(const Equation& equation, const at::Tensor& u, const c10::SymInt& solves,
                   const SolveOptions& options) {
  equation.check_picard_steps();
  options.check(operator_kind(equation.kind).title);
  check_memory(options, u);
  TORCH_CHECK_VALUE(solves.is_symbolic() || solves.expect_int() >= 0, "rollout: steps must be >= 0, got ",
                    solves / equation.picard_steps);
  const auto a = equation_operator(equation, u);
  make_operator(a)->check_vector(u);
  check_devices(a, u);
}

SolveOutputs solve_all(const Equation& equation, const at::Tensor& u, const c10::SymInt& solves,
                       const SolveOptions& options) {
  check_rollout(equation, u, solves, options);
  const int64_t picard = equation.picard_steps;
  at::Tensor b;
  return outputs_of(solve_in_place(u, solves.expect_int(), picard, [&](const at::Tensor& last, int64_t s) {
    if (s % picard == 0) b = equation_rhs(equation, last);
    return linear_solve_unrecorded(equation_operator(equation, last), b, options, start_of_step(options, last));
  }));
}

SolveOutputs fake_solves(const Equation& equation, const at::Tensor& u, const c10::SymInt& solves,
                         const SolveOptions& options) {
  check_rollout(equation, u, solves, options);
  auto sizes = u.sym_sizes().vec();
  sizes.insert(sizes.begin() + 1, solves + 1);
  return outputs_of({at::empty_symint(sizes, u.options()), empty_info(u, {u.sym_size(0), solves})});
}

/// The reverse of solve_all(): a gradient for each 1 in `needed`, zeros where there is none.
std::vector<at::Tensor> solve_all_back(const at::Tensor& cotangent, const KeptSolves& kept, const Equation& equation,
                                       const SolveOptions& options, at::IntArrayRef needed) {
  const at::NoGradGuard no_grad;
  auto found = vjp_of_solves(cotangent, kept, equation, options, needed, linear_solve_unrecorded);
  if (needed[0]) found[0] = found[0].contiguous();  // defined where it is needed
  for (size_t i = 1; i < found.size(); ++i)
    if (needed[i] && !found[i].defined()) found[i] = at::zeros_like(equation.tensors[i - 1]);
  return only_needed(found, needed);
}

template <class... Args>
std::vector<at::Tensor> vjp_kernel(const at::Tensor& cotangent, const OptionalTensor& solutions,
                                   const OptionalTensor& iterations, const OptionalTensor& status,
                                   const OptionalTensor& residual, at::IntArrayRef needed, Args... args) {
  const KeptSolves kept{solutions.value_or(at::Tensor()), iterations.value_or(at::Tensor()),
                        status.value_or(at::Tensor()), residual.value_or(at::Tensor())};
  const auto kernel = [&](const Equation& equation, const auto&... packed) {
    equation.check_picard_steps();
    return solve_all_back(cotangent, kept, equation, unpack(packed...), needed);
  };
  return with_equation(kernel, args...);
}

template <class... Args>
std::vector<at::Tensor> fake_vjp(const at::Tensor& cotangent, const OptionalTensor&, const OptionalTensor&,
                                 const OptionalTensor&, const OptionalTensor&, at::IntArrayRef needed, Args... args) {
  const auto kernel = [&](const Equation& equation, const auto&...) {
    auto sizes = cotangent.sym_sizes().vec();
    sizes.erase(sizes.begin() + 1);
    return empty_gradients(cotangent, sizes, equation.tensors, needed);
  };
  return with_equation(kernel, args...);
}

std::vector<at::Tensor> call_vjp(const at::Tensor& cotangent, const KeptSolves& kept, const Equation& e,
                                 const SolveOptions& o, at::IntArrayRef needed) {
  static const auto op = c10::Dispatcher::singleton().findSchemaOrThrow("prdp::rollout_vjp", "").typed<VjpSignature>();
  return call_with_options(op, o, cotangent, or_none(kept.solutions), or_none(kept.iterations), or_none(kept.status),
                           or_none(kept.residual), needed, e.tensors, e.kind, e.shape, e.parameters, e.picard_steps);
}

/// The solves of so many steps. Raises ValueError if an int64_t cannot hold their number.
c10::SymInt count_solves(const c10::SymInt& steps, int64_t picard) {
  const int64_t most = std::numeric_limits<int64_t>::max() / std::max<int64_t>(picard, 1);
  TORCH_CHECK_VALUE(steps.is_symbolic() || (steps.expect_int() <= most && steps.expect_int() >= -most),
                    "rollout: steps times picard_steps must be below 2^63, got ", steps, " times ", picard);
  return steps * picard;
}

/// A rollout as single steps, each of which has all derivatives.
SolveResult step_by_step(const Equation& equation, const at::Tensor& u, int64_t steps, SolveOptions options) {
  check_rollout(equation, u, count_solves(steps, equation.picard_steps), options);
  options.adjoint_log = 0;  // it would hold the first step's alone
  return solve_by_solve(u, steps, 1, [&](const at::Tensor& state, int64_t) { return step(equation, state, options); });
}

/// Combines the reports of the solves of each step.
SolveInfo reports_of_steps(const SolveInfo& solves, const c10::SymInt& steps, int64_t picard) {
  const auto of_solve = [&](int64_t k) {
    const auto part = [&](const at::Tensor& t) { return t.unflatten_symint(1, {steps, picard}).select(-1, k); };
    return SolveInfo{part(solves.iterations), part(solves.residual), part(solves.status),
                     part(solves.operator_applications), part(solves.floor)};
  };
  auto all = of_solve(0);
  for (int64_t k = 1; k < picard; ++k) all = joined(all, of_solve(k));
  return all;
}

SolveOutputs outputs_of_rollout(const Equation& equation, const at::Tensor& u, const c10::SymInt& steps,
                                const SolveOptions& options) {
  return outputs_of(rollout(equation, u, steps, options));
}

/// The kernel of an op: calls run(equation, u, count, options), where `count` is of solves, or of steps.
template <auto run, class... Args>
SolveOutputs packed_op(const at::Tensor& u, Args... args) {
  const auto kernel = [&](const Equation& equation, const c10::SymInt& count, const auto&... packed) {
    return run(equation, u, count, unpack(packed...));
  };
  return with_equation(kernel, args...);
}

}  // namespace

SolveOutputs rollout_below_autograd(const Equation& e, const at::Tensor& u, const c10::SymInt& solves,
                                    const SolveOptions& o) {
  const at::AutoDispatchBelowADInplaceOrView below;
  return is_plain_call(u, e.tensors, o) ? solve_all(e, u, solves, o) : call_solves(e, u, solves, o);
}

std::vector<at::Tensor> rollout_vjp_below_autograd(const at::Tensor& cotangent, const KeptSolves& kept,
                                                   const Equation& e, const SolveOptions& o, at::IntArrayRef needed) {
  return (is_plain_call(cotangent, e.tensors, o) ? solve_all_back : call_vjp)(cotangent, kept, e, o, needed);
}

SolveResult rollout(const Equation& equation, const at::Tensor& u, const c10::SymInt& steps,
                    const SolveOptions& options) {
  // prdp::rollout_solves supports neither forward mode nor torch.func; single steps do.
  if (in_torch_func() || has_tangent(u) || any_tangent(equation.tensors))
    return step_by_step(equation, u, steps.expect_int(), options);
  const int64_t picard = equation.picard_steps;
  const auto solves = count_solves(steps, picard);
  const auto solve = no_mode_is_on() && is_plain_call(u, equation.tensors, options) ? record_rollout : call_solves;
  auto [solutions, info] = result_of(solve(equation, u, solves, options));
  if (options.backward == Backward::kNone) solutions = from_state(u, solutions);
  if (picard == 1) return {solutions, info};
  return {solutions.slice_symint(1, 0, std::nullopt, picard), reports_of_steps(info, steps, picard)};
}

TORCH_LIBRARY_FRAGMENT(prdp, m) {
  m.def(kSolvesSchema, {at::Tag::pt2_compliant_tag});
  m.def(kVjpSchema, {at::Tag::pt2_compliant_tag});
  m.def(kRolloutSchema, static_cast<SolvesSignature*>(packed_op<outputs_of_rollout>));
}
TORCH_LIBRARY_IMPL(prdp, CompositeExplicitAutograd, m) {
  m.impl("rollout_solves", static_cast<SolvesSignature*>(packed_op<solve_all>));
  m.impl("rollout_vjp", static_cast<VjpSignature*>(vjp_kernel));
}
TORCH_LIBRARY_IMPL(prdp, Meta, m) {
  m.impl("rollout_solves", static_cast<SolvesSignature*>(packed_op<fake_solves>));
  m.impl("rollout_vjp", static_cast<VjpSignature*>(fake_vjp));
}
TORCH_LIBRARY_IMPL(prdp, Autograd, m) {
  m.impl("rollout_solves", static_cast<SolvesSignature*>(packed_op<record_rollout>));
}

TORCH_LIBRARY_IMPL(prdp, FuncTorchBatchedDecomposition, m) {
  m.impl("rollout", static_cast<SolvesSignature*>(packed_op<outputs_of_rollout>));
}

}  // namespace prdp
