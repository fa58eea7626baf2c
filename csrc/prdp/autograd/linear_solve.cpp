#include "prdp/autograd/linear_solve.h"

#include <ATen/TensorSubclassLikeUtils.h>
#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/custom_class.h>
#include <torch/library.h>

#include "prdp/autograd/adjoint_log.h"
#include "prdp/autograd/flat_options.h"
#include "prdp/autograd/solve_vjp.h"
#include "prdp/operators/function_operator.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;
using Outputs = std::tuple<at::Tensor, at::Tensor, at::Tensor, at::Tensor, at::Tensor>;

constexpr const char* kSchema =
    "linear_solve(Tensor b, Tensor[] tensors, str kind, int[] shape, float[] parameters, bool transposed, "
    PRDP_OPTIONS_SCHEMA ") -> "
    "(Tensor u, Tensor iterations, Tensor residual, Tensor status, Tensor operator_applications)";

/// The arguments of the op but b: what travels from the forward to the backward pass.
struct Call : torch::CustomClassHolder {
  OperatorSpec a;
  SolveOptions options;
  std::shared_ptr<const RegisteredProducts> products;  // kept alive for the backward pass
  std::pair<int64_t, int64_t> step;                    // of a rollout, for what the backward pass reports
};

using Signature = WithOptions<Outputs(const at::Tensor&, at::TensorList, c10::string_view, at::IntArrayRef,
                                      at::ArrayRef<double>, bool)>;

Outputs call_op(const at::Tensor& b, const OperatorSpec& a, const SolveOptions& o) {
  static const auto op = c10::Dispatcher::singleton()
                             .findSchemaOrThrow("prdp::linear_solve", "")
                             .typed<Signature>();
  return call_with_options(op, o, b, at::TensorList(a.tensors), c10::string_view(a.kind),
                           at::IntArrayRef(a.shape), at::ArrayRef<double>(a.parameters), a.transposed);
}

/// The op's arguments as structures; raises for names that do not exist.
template <class... Options>
c10::intrusive_ptr<Call> unpack(at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                                at::ArrayRef<double> parameters, bool transposed, Options... options) {
  auto call = c10::make_intrusive<Call>();
  call->a = {std::string(kind), shape.vec(), parameters.vec(), tensors.vec(), transposed};
  call->options = unflatten(std::move(options)...);
  return call;
}

const char* role_of(const OperatorSpec& a) { return a.transposed ? "adjoint solve" : "linear_solve"; }

std::unique_ptr<Operator> checked_operator(const OperatorSpec& spec, const at::Tensor& b,
                                           const SolveOptions& options) {
  options.check(role_of(spec));
  auto a = make_operator(spec);
  a->check_vector(b);
  return a;
}

template <class... Args>
Outputs solve_kernel(const at::Tensor& b, Args... args) {
  const auto call = unpack(std::move(args)...);
  const auto [u, info] = linear_solve_kernel(call->a, b, call->options);
  return {u, info.iterations, info.residual, info.status, info.operator_applications};
}

/// Shapes and dtypes only, for fake tensors.
template <class... Args>
Outputs fake_kernel(const at::Tensor& b, Args... args) {
  const auto call = unpack(std::move(args)...);
  checked_operator(call->a, b, call->options);
  const auto counts = [&] { return at::empty_symint({b.sym_size(0)}, b.options().dtype(at::kLong)); };
  return {at::empty_symint(b.sym_sizes(), b.options()), counts(),
          at::empty_symint({b.sym_size(0)}, b.options()), counts(), counts()};
}

/// Whether tensors are what they seem, not fake, wrapped or watched: then the dispatcher has nothing to add
/// to a kernel, and its way through the flat arguments is saved.
bool is_plain(const at::Tensor& t) { return !at::isTensorSubclassLike(t); }

/// The op below autograd.
Outputs call_below(const at::Tensor& b, const OperatorSpec& a, const SolveOptions& o) {
  const at::AutoDispatchBelowADInplaceOrView below;
  if (!is_plain(b)) return call_op(b, a, o);
  const auto [u, info] = linear_solve_kernel(a, b, o);
  return {u, info.iterations, info.residual, info.status, info.operator_applications};
}

class LinearSolve : public torch::autograd::Function<LinearSolve> {
 public:
  static variable_list forward(AutogradContext* ctx, const at::Tensor& b, at::TensorList tensors,
                               const c10::intrusive_ptr<Call>& call) {
    const auto [u, iterations, residual, status, applications] = call_below(b, call->a, call->options);
    ctx->mark_non_differentiable({iterations, residual, status, applications});
    ctx->set_materialize_grads(false);

    // Implicit mode keeps u alone, and that only if A has a derivative; b and the iteration counts
    // are unrolled mode's. Where a failed sample may have passed, its status says so.
    const bool unrolled = call->options.backward == Backward::kUnrolled;
    const bool differentiates_a = any_requires_grad(tensors);
    const bool may_have_failed = call->options.on_failure != OnFailure::kRaise;
    variable_list saved{unrolled ? b : differentiates_a ? u : at::Tensor(),
                        unrolled ? iterations : at::Tensor(),
                        unrolled || may_have_failed ? status : at::Tensor()};
    saved.insert(saved.end(), tensors.begin(), tensors.end());
    ctx->save_for_backward(std::move(saved));

    if (call->a.kind == "function") call->products = RegisteredProducts::find(call->a.shape[0]);
    call->step = FailuresOfStep::now();
    call->a.tensors.clear();  // they are among the saved ones
    ctx->saved_data["call"] = c10::IValue::make_capsule(call);
    return {u, iterations, residual, status, applications};
  }

  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    const auto saved = ctx->get_saved_variables();
    const auto call = c10::static_intrusive_pointer_cast<Call>(ctx->saved_data["call"].toCapsule());
    const FailuresOfStep here(call->step.first, call->step.second);
    auto a = call->a;
    a.tensors.assign(saved.begin() + 3, saved.end());
    const size_t inputs = a.tensors.size() + 1;
    variable_list out(inputs + 1);  // b, the tensors, and the call, which has no gradient
    if (!grads[0].defined()) return out;
    std::vector<int64_t> needed(inputs);
    for (size_t i = 0; i < inputs; ++i) needed[i] = ctx->needs_input_grad(i);
    auto& adjoint_solve =
        at::GradMode::is_enabled() || !is_plain(grads[0]) ? linear_solve : linear_solve_kernel;
    const Solved solved{saved[0], saved[0], saved[1], saved[2]};
    const auto found = solve_vjp(grads[0], solved, a, call->options, needed, adjoint_solve);
    std::copy(found.gradients.begin(), found.gradients.end(), out.begin());
    return out;
  }
};

template <class... Args>
Outputs autograd_kernel(const at::Tensor& b, Args... args) {
  const auto call = unpack(args...);
  const auto tensors = call->a.tensors;
  const bool may_differentiate = at::GradMode::is_enabled() && call->options.backward != Backward::kNone;
  if (may_differentiate && call->a.kind == "function") refuse_captured_gradients(call->a);
  const bool differentiable = may_differentiate && (b.requires_grad() || any_requires_grad(tensors));
  if (!differentiable) return call_below(b, call->a, call->options);
  const auto out = LinearSolve::apply(b, at::TensorList(tensors), call);
  return {out[0], out[1], out[2], out[3], out[4]};
}

/// A function pointer with the op's signature out of a template over its arguments.
template <class>
struct Kernels;
template <class... Args>
struct Kernels<Outputs(const at::Tensor&, Args...)> {
  static Outputs solve(const at::Tensor& b, Args... args) { return solve_kernel<Args...>(b, args...); }
  static Outputs fake(const at::Tensor& b, Args... args) { return fake_kernel<Args...>(b, args...); }
  static Outputs autograd(const at::Tensor& b, Args... args) {
    return autograd_kernel<Args...>(b, args...);
  }
};

}  // namespace

SolveResult linear_solve(const OperatorSpec& a, const at::Tensor& b, const SolveOptions& options) {
  const bool lone_vector = b.dim() == 1 && a.shape.empty();  // (n,), for matrices
  auto [u, iterations, residual, status, applications] =
      call_op(lone_vector ? b.unsqueeze(0) : b, a, options);
  return {lone_vector ? u.squeeze(0) : u, {iterations, residual, status, applications}};
}

SolveResult linear_solve_kernel(const OperatorSpec& spec, const at::Tensor& b, const SolveOptions& options) {
  const auto a = checked_operator(spec, b, options);
  a->check_parameters();
  const auto& s = options.solver;
  auto result = solve(*a, b, {s.method, s.max_iter.expect_int(), s.rtol, s.restart});
  auto& info = result.info;
  if (spec.transposed && options.adjoint_log != 0) adjoint_log::write(options.adjoint_log, info);
  report_failures(*a, b, info, options.on_failure, role_of(spec));
  if (!b.is_cpu())
    for (auto* part : {&info.iterations, &info.residual, &info.status, &info.operator_applications})
      *part = part->to(b.device());
  return result;
}

OperatorSpec matrix(const at::Tensor& values) {
  if (values.layout() == at::kSparseCsr)
    return {"csr", {}, {}, {values.crow_indices(), values.col_indices(), values.values()}};
  TORCH_CHECK_VALUE(values.layout() == at::kStrided,
                    "linear_solve: A must be a dense or sparse CSR tensor, got ", values.layout());
  return {"dense", {}, {}, {values}};
}

TORCH_LIBRARY_FRAGMENT(prdp, m) { m.def(kSchema, {at::Tag::pt2_compliant_tag}); }
TORCH_LIBRARY_IMPL(prdp, CompositeExplicitAutograd, m) {
  m.impl("linear_solve", Kernels<Signature>::solve);
}
TORCH_LIBRARY_IMPL(prdp, Meta, m) { m.impl("linear_solve", Kernels<Signature>::fake); }
TORCH_LIBRARY_IMPL(prdp, Autograd, m) { m.impl("linear_solve", Kernels<Signature>::autograd); }

}  // namespace prdp
