#include "prdp/autograd/linear_solve.h"

#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/custom_class.h>
#include <torch/library.h>

#include "prdp/autograd/adjoint_log.h"
#include "prdp/autograd/unrolled_vjp.h"
#include "prdp/operators/function_operator.h"

namespace prdp {

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;
using Outputs = std::tuple<at::Tensor, at::Tensor, at::Tensor, at::Tensor, at::Tensor>;

constexpr const char* kSchema =
    "linear_solve(Tensor b, Tensor[] tensors, str kind, int[] shape, float[] parameters, "
    "bool transposed, str solver, SymInt max_iter, float rtol, int restart, str backward, "
    "SymInt? adjoint_max_iter, float? adjoint_rtol, str on_failure, int adjoint_log) -> "
    "(Tensor u, Tensor iterations, Tensor residual, Tensor status, Tensor operator_applications)";

/// The arguments of the op but b: what travels from the forward to the backward pass.
struct Call : torch::CustomClassHolder {
  OperatorSpec a;
  SolveOptions options;
  std::shared_ptr<const RegisteredProducts> products;  // kept alive for the backward pass
};

using Signature = Outputs(const at::Tensor&, at::TensorList, c10::string_view, at::IntArrayRef,
                          at::ArrayRef<double>, bool, c10::string_view, c10::SymInt, double,
                          int64_t, c10::string_view, std::optional<c10::SymInt>, std::optional<double>,
                          c10::string_view, int64_t);

/// Calls the op through the dispatcher.
Outputs call_op(const at::Tensor& b, const OperatorSpec& a, const SolveOptions& o) {
  static const auto op = c10::Dispatcher::singleton()
                             .findSchemaOrThrow("prdp::linear_solve", "")
                             .typed<Signature>();
  return op.call(b, a.tensors, a.kind, a.shape, a.parameters, a.transposed, name(o.solver.method),
                 o.solver.max_iter, o.solver.rtol, o.solver.restart, name(o.backward), o.adjoint_max_iter,
                 o.adjoint_rtol, name(o.on_failure), o.adjoint_log);
}

/// The op's arguments as structures; raises for names that do not exist.
c10::intrusive_ptr<Call> unpack(at::TensorList tensors, c10::string_view kind, at::IntArrayRef shape,
                                at::ArrayRef<double> parameters, bool transposed,
                                c10::string_view solver, c10::SymInt max_iter, double rtol,
                                int64_t restart, c10::string_view backward, std::optional<c10::SymInt> adjoint_max_iter,
                                std::optional<double> adjoint_rtol, c10::string_view on_failure,
                                int64_t adjoint_log) {
  auto call = c10::make_intrusive<Call>();
  call->a = {std::string(kind), shape.vec(), parameters.vec(), tensors.vec(), transposed};
  call->options = {{method_from_name(solver), std::move(max_iter), rtol, restart},
                   backward_from_name(backward),
                   std::move(adjoint_max_iter),
                   adjoint_rtol,
                   on_failure_from_name(on_failure),
                   adjoint_log};
  return call;
}

const char* role_of(const OperatorSpec& a) { return a.transposed ? "adjoint solve" : "linear_solve"; }

std::unique_ptr<Operator> checked_operator(const at::Tensor& b, const Call& call) {
  call.options.check(role_of(call.a));
  auto a = make_operator(call.a);
  a->check_vector(b);
  return a;
}

/// Below autograd: solve, log, report.
template <class... Args>
Outputs solve_kernel(const at::Tensor& b, Args... args) {
  const auto call = unpack(std::move(args)...);
  const auto a = checked_operator(b, *call);
  a->check_parameters();
  const auto& o = call->options;
  const auto& s = o.solver;
  const auto result = solve(*a, b, {s.method, s.max_iter.expect_int(), s.rtol, s.restart});
  if (call->a.transposed && o.adjoint_log != 0) adjoint_log::write(o.adjoint_log, result.info);
  report_failures(*a, b, result.info, o.on_failure, role_of(call->a));
  const auto& info = result.info;
  const auto there = b.device();
  return {result.u, info.iterations.to(there), info.residual.to(there), info.status.to(there),
          info.operator_applications.to(there)};
}

/// Shapes and dtypes only, for fake tensors.
template <class... Args>
Outputs fake_kernel(const at::Tensor& b, Args... args) {
  const auto call = unpack(std::move(args)...);
  checked_operator(b, *call);
  const auto counts = [&] { return at::empty_symint({b.sym_size(0)}, b.options().dtype(at::kLong)); };
  return {at::empty_symint(b.sym_sizes(), b.options()), counts(),
          at::empty_symint({b.sym_size(0)}, b.options()), counts(), counts()};
}

/// (batch,) → (batch, 1, …)
at::Tensor per_sample(const at::Tensor& t, const at::Tensor& like) {
  auto wide = t;
  for (int64_t d = 1; d < like.dim(); ++d) wide = wide.unsqueeze(-1);
  return wide;
}

class LinearSolve : public torch::autograd::Function<LinearSolve> {
 public:
  static variable_list forward(AutogradContext* ctx, const at::Tensor& b, at::TensorList tensors,
                               const c10::intrusive_ptr<Call>& call) {
    const at::AutoDispatchBelowADInplaceOrView below;
    const auto [u, iterations, residual, status, applications] = call_op(b, call->a, call->options);
    ctx->mark_non_differentiable({iterations, residual, status, applications});
    ctx->set_materialize_grads(false);

    // Implicit mode keeps u alone, and that only if A has a derivative; b and the iteration counts
    // are unrolled mode's. Where a failed sample may have passed, its status says so.
    const bool unrolled = call->options.backward == Backward::kUnrolled;
    const bool differentiates_a = std::any_of(tensors.begin(), tensors.end(),
                                              [](const at::Tensor& t) { return t.requires_grad(); });
    const bool may_have_failed = call->options.on_failure != OnFailure::kRaise;
    variable_list saved{unrolled ? b : differentiates_a ? u : at::Tensor(),
                        unrolled ? iterations : at::Tensor(),
                        unrolled || may_have_failed ? status : at::Tensor()};
    saved.insert(saved.end(), tensors.begin(), tensors.end());
    ctx->save_for_backward(saved);

    auto kept = c10::make_intrusive<Call>();
    kept->a = call->a;
    kept->a.tensors.clear();
    kept->options = call->options;
    if (call->a.kind == "function") kept->products = RegisteredProducts::find(call->a.shape[0]);
    ctx->saved_data["call"] = c10::IValue::make_capsule(kept);
    return {u, iterations, residual, status, applications};
  }

  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    const auto saved = ctx->get_saved_variables();
    const auto& status = saved[2];
    auto call = c10::make_intrusive<Call>(*c10::static_intrusive_pointer_cast<Call>(
        ctx->saved_data["call"].toCapsule()));
    call->a.tensors.assign(saved.begin() + 3, saved.end());
    const size_t inputs = call->a.tensors.size() + 1;
    variable_list out(inputs + 1);  // b, the tensors, and the call, which has no gradient
    auto cotangent = grads[0];
    if (!cotangent.defined()) return out;
    if (call->options.on_failure != OnFailure::kRaise) {
      // A refused sample's u is the constant zero.
      const auto refused = status.eq(static_cast<int64_t>(SolveStatus::kZeroDiagonal))
                               .logical_or(status.le(static_cast<int64_t>(SolveStatus::kNonfiniteInput)));
      cotangent = cotangent.masked_fill(per_sample(refused, cotangent), 0.0);
    }

    std::vector<int64_t> needed(inputs);
    for (size_t i = 0; i < inputs; ++i) needed[i] = ctx->needs_input_grad(i);
    const auto found = call->options.backward == Backward::kUnrolled
                           ? unrolled(cotangent, saved[0], *call, needed, saved[1], status)
                           : implicit(cotangent, saved[0], *call, needed);
    std::copy(found.begin(), found.end(), out.begin());
    return out;
  }

 private:
  /// Aᵀ λ = ū; b̄ = λ; ḡ = -∂⟨λ, A(g) u⟩/∂g. Again differentiable: the solve is the same op.
  static variable_list implicit(const at::Tensor& cotangent, const at::Tensor& u, const Call& call,
                                at::IntArrayRef needed) {
    auto a = call.a;
    a.transposed = !a.transposed;
    auto o = call.options;
    o.solver.max_iter = o.adjoint_max_iter.value_or(o.solver.max_iter);
    o.solver.rtol = o.adjoint_rtol.value_or(o.solver.rtol);
    const auto lambda = std::get<0>(call_op(cotangent, a, o));

    variable_list found(needed.size());
    if (needed[0]) found[0] = lambda;
    if (!u.defined()) return found;
    const auto products = make_operator(call.a)->product_rule(lambda, u);
    for (size_t i = 0; i < products.size(); ++i)
      if (needed[i + 1] && products[i].defined()) found[i + 1] = products[i].neg();
    return found;
  }

  static variable_list unrolled(const at::Tensor& cotangent, const at::Tensor& b, const Call& call,
                                at::IntArrayRef needed, const at::Tensor& iterations,
                                const at::Tensor& status) {
    const UnrolledSolve solve{call.a, call.options.solver, iterations, status};
    // With create_graph=True the derivative is itself recorded; else it is one op, as a compiled
    // graph needs it.
    const auto gradients = at::GradMode::is_enabled() ? unrolled_vjp_recorded(cotangent, b, solve, needed)
                                                      : unrolled_vjp(cotangent, b, solve, needed);
    variable_list found(needed.size());
    size_t next = 0;
    for (size_t i = 0; i < needed.size(); ++i)
      if (needed[i]) found[i] = gradients[next++];
    return found;
  }
};

template <class... Args>
Outputs autograd_kernel(const at::Tensor& b, Args... args) {
  const auto call = unpack(args...);
  const auto& tensors = call->a.tensors;
  const bool differentiable =
      at::GradMode::is_enabled() && call->options.backward != Backward::kNone &&
      (b.requires_grad() || std::any_of(tensors.begin(), tensors.end(),
                                        [](const at::Tensor& t) { return t.requires_grad(); }));
  if (!differentiable) {
    const at::AutoDispatchBelowADInplaceOrView below;
    return call_op(b, call->a, call->options);
  }
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
