#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/functions/utils.h>
#include <torch/library.h>

#include "prdp/autograd/adjoint_log.h"
#include "prdp/autograd/linear_solve.h"
#include "prdp/autograd/op_results.h"
#include "prdp/autograd/packed_options.h"
#include "prdp/autograd/solve_jvp.h"
#include "prdp/autograd/solve_node.h"
#include "prdp/autograd/unreached_tensors.h"
#include "prdp/error_text.h"
#include "prdp/operators/function_checks.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/singular_operator.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/memory_check.h"
#include "prdp/solvers/report_failures.h"
#include "prdp/solvers/solve_on_gpu.h"
#include "prdp/solvers/uneven_rows.h"
#include "prdp/solvers/warnings.h"

namespace prdp {

namespace {

constexpr const char* kSchema = "linear_solve(Tensor b, " PRDP_SOLVE_SCHEMA ") -> (Tensor u, " PRDP_REPORT_SCHEMA ")";
using Signature = WithSolve<SolveOutputs(const at::Tensor&)>;

// The way of a solve, each function calling the next. Plain tensors take it all; for others `call_op` goes through the
// dispatcher, from the second step to `autograd_op` below, and from the fifth to `solve_op`.
//   1. linear_solve: a lone vector (n,) as a batch of one
//   2. solve_or_dispatch
//   3. solve_and_differentiate_null_space: the part of u̇ that comes of a null space which depends on parameters
//   4. solve_with_node: records a node for reverse mode, and makes the tangent of forward mode
//   5. call_op_below_autograd
//   6. linear_solve_unrecorded: checks, solves and reports; what adjoint solves call, too

SolveOutputs call_op(const at::Tensor& b, const OperatorSpec& a, const SolveOptions& o, const at::Tensor& x0) {
  static const auto op = c10::Dispatcher::singleton().findSchemaOrThrow("prdp::linear_solve", "").typed<Signature>();
  return call_with_solve(op, a, x0, o, b);
}

/// The op's arguments. Each part of the report gets memory of its own, as a compiled graph refuses results that share
/// it.
template <class... Args>
SolveCall unpack_op(const Args&... args) {
  auto call = unpack_solve(args...);
  call.options.report_apart = true;
  return call;
}

const char* role_of(const OperatorSpec& a) { return a.transposed ? "adjoint solve" : "linear_solve"; }

void check_multigrid(const Operator& a, const OperatorSpec& spec, const Solver& solver) {
  if (!solver.preconditioner.is_multigrid()) return;
  const bool alone = solver.method == Method::kMultigrid;
  TORCH_CHECK_VALUE(alone ? a.has_coarse_grids() : a.has_multigrid_preconditioner(), role_of(spec), ": ",
                    alone ? "the method Multigrid" : "preconditioner \"multigrid\"",
                    " is for Heat, Poisson, Burgers, Diffusion,", alone ? "" : " NavierStokes,",
                    " and Stencil with neighbours at most one cell away, not for this ",
                    operator_kind(spec.kind).title);
}

std::unique_ptr<Operator> checked_operator(const OperatorSpec& spec, const at::Tensor& b, const SolveOptions& options,
                                           const at::Tensor& x0) {
  options.check(role_of(spec));
  auto a = make_operator(spec);
  a->check_vector(b);
  check_devices(spec, b);
  if (options.solver.preconditioner.is_operator()) check_devices(options.solver.preconditioner.spec(), b);
  check_multigrid(*a, spec, options.solver);
  TORCH_CHECK_VALUE(!x0.defined() || (x0.sym_sizes() == b.sym_sizes() && x0.scalar_type() == b.scalar_type() &&
                                      x0.device() == b.device()),
                    role_of(spec), ": x0 must have the shape, dtype and device of b, ", b.sym_sizes(), " in ",
                    dtype_name(b.scalar_type()), " on ", b.device(), ", got ", x0.sym_sizes(), " in ",
                    dtype_name(x0.scalar_type()), " on ", x0.device());
  return a;
}

template <class... Args>
SolveOutputs solve_op(const at::Tensor& b, Args... args) {
  const auto [a, options, x0] = unpack_op(args...);
  return outputs_of(linear_solve_unrecorded(a, b, options, x0));
}

/// Shapes and dtypes only, for fake tensors.
template <class... Args>
SolveOutputs fake_op(const at::Tensor& b, Args... args) {
  const auto [a, options, x0] = unpack_op(args...);
  checked_operator(a, b, options, x0);
  return outputs_of({at::empty_symint(b.sym_sizes(), b.options()), empty_info(b, {b.sym_size(0)})});
}

bool is_plain_solve(const at::Tensor& b, const OperatorSpec& a, const SolveOptions& o, const at::Tensor& x0) {
  return is_plain_call(b, a.tensors, o) && (!x0.defined() || is_plain(x0));
}

/// The op below autograd.
SolveOutputs call_op_below_autograd(const at::Tensor& b, const OperatorSpec& a, const SolveOptions& o,
                                    const at::Tensor& x0) {
  const at::AutoDispatchBelowADInplaceOrView below;
  if (!is_plain_solve(b, a, o, x0)) return call_op(b, a, o, x0);
  return outputs_of(linear_solve_unrecorded(a, b, o, x0));
}

at::Tensor without_derivative(const at::Tensor& t) { return t.defined() ? primal(t).detach() : t; }

/// The op's autograd kernel, but for what depends on the null spaces.
SolveOutputs solve_with_node(const at::Tensor& b, const OperatorSpec& a, const SolveOptions& options,
                             const at::Tensor& x0) {
  const bool differentiable = options.backward != Backward::kNone;
  if (differentiable && is_function(a)) {
    const bool in_grad_mode = at::GradMode::is_enabled();  // which forward mode ignores
    if (in_torch_func() || (!in_grad_mode && in_forward_mode())) refuse_captured_transforms(a, b);
    else if (in_grad_mode && is_plain(b) && all_plain(a.tensors)) refuse_captured_gradients(a);
  }
  const bool reverse =
      differentiable && at::GradMode::is_enabled() && (b.requires_grad() || any_requires_grad(a.tensors));
  const bool forward = differentiable && (has_tangent(b) || any_tangent(a.tensors));
  const auto node = reverse ? make_node<SolveNode>(b, a, options) : nullptr;
  const auto out = call_op_below_autograd(b, a, node ? node->options() : options, x0);
  const auto& [u, iterations, residual, status, applications, floor] = out;
  if (reverse && is_function(a) && is_plain(b) && all_plain(a.tensors) && !in_torch_func() &&
      any_requires_grad(a.tensors))
    warn_of_unreached_tensors(a, b);
  const Solved solved{b, u, iterations, status, residual, without_derivative(x0)};  // a start is a constant
  if (reverse) torch::autograd::set_history(u, node);
  if (forward) u._set_fw_grad(solve_jvp(b, solved, a, options), /*level=*/0, /*is_inplace_op=*/false);
  if (reverse) node->save(b, solved);
  return out;
}

/// The op's autograd kernel.
SolveOutputs solve_and_differentiate_null_space(const at::Tensor& b, const OperatorSpec& a, const SolveOptions& options,
                                                const at::Tensor& x0) {
  if (!is_singular(a) || options.backward == Backward::kNone) return solve_with_node(b, a, options, x0);
  const auto bases = at::TensorList(a.tensors).slice(a.tensors.size() - 2);
  if (!any_needs_derivative(bases)) return solve_with_node(b, a, options, x0);
  auto fixed = a;
  for (size_t k = 0; k < 2; ++k) fixed.tensors[a.tensors.size() - 2 + k] = without_derivative(bases[k]);
  auto out = solve_with_node(b, fixed, options, x0);
  if (const auto& basis = bases[a.transposed]; any_needs_derivative(basis))
    std::get<0>(out) = follow_null_space(std::get<0>(out), basis);
  return out;
}

/// Records without the dispatcher, which would pack and unpack the options, where no mode or subclass is to see the op;
/// else calls the op.
SolveOutputs solve_or_dispatch(const at::Tensor& b, const OperatorSpec& a, const SolveOptions& options,
                               const at::Tensor& x0) {
  if (is_function(a) && in_vmap()) refuse_mapped_captures(a, b);  // its rule runs outside, where none has a meaning
  if (!no_mode_but_a_profiler_is_on() || !is_plain_solve(b, a, options, x0)) return call_op(b, a, options, x0);
  RECORD_FUNCTION("prdp::linear_solve", c10::ArrayRef<const c10::IValue>());  // as the dispatcher does
  return solve_and_differentiate_null_space(b, a, options, x0);
}

template <class... Args>
SolveOutputs autograd_op(const at::Tensor& b, Args... args) {
  const auto [a, options, x0] = unpack_op(args...);
  return solve_and_differentiate_null_space(b, a, options, x0);
}

/// Warns where b - A u is not what the solve, which scales b, found: A of a Function is not linear.
void warn_of_nonlinear_product(const OperatorSpec& a, const at::Tensor& b, const at::Tensor& u,
                               const at::Tensor& residual) {
  if (is_singular(a)) return;
  const at::NoGradGuard no_grad;
  auto constant = a;
  constant.tensors = detached(a.tensors);
  const auto left = sample_norms(b - make_operator(constant)->apply(u)) / sample_norms(b);
  const auto known = residual.to(at::kDouble);
  // Of a linear product the two are the same but for rounding. One by differences may differ a little.
  constexpr double by_differences = 1e-3;
  const auto wrong = (known < by_differences) & (left > 10.0 * known + by_differences) & left.isfinite();
  if (!wrong.any().item<bool>()) return;
  const auto worst = left.masked_fill(wrong.logical_not(), 0.0).argmax().item<int64_t>();
  std::ostringstream key;
  key << "nonlinear product " << products_of(a)->code.get();
  warn_once(key.str(), left[worst].item<double>(), [&](std::ostringstream& text) {
    text << "Function: " << product_name() << " is not linear: in sample " << worst << ", |b - A u| is "
         << left[worst].item<double>() << " |b|, where the solve, of b scaled to the order of one, found "
         << known[worst].item<double>();
  });
}

}  // namespace

SolveResult linear_solve(const OperatorSpec& a, const at::Tensor& b, const SolveOptions& options,
                         const at::Tensor& x0) {
  TORCH_CHECK_VALUE(b.defined(), "linear_solve: b is an undefined tensor");
  for (const auto* t : {&b, &x0})
    TORCH_CHECK_VALUE(!t->defined() || t->layout() == at::kStrided, "linear_solve: ", t == &b ? "b" : "x0",
                      " must be a dense tensor, got the layout ", t->layout());
  const bool lone_vector = b.dim() == 1 && a.shape.empty();  // (n,), for matrices
  if (!lone_vector) return result_of(solve_or_dispatch(b, a, options, x0));
  auto result = result_of(solve_or_dispatch(b.unsqueeze(0), a, options, x0.defined() ? x0.unsqueeze(0) : x0));
  result.u = result.u.squeeze(0);
  return result;
}

SolveResult linear_solve_unrecorded(const OperatorSpec& spec, const at::Tensor& b, const SolveOptions& options,
                                    const at::Tensor& x0) {
  const auto a = checked_operator(spec, b, options, x0);
  check_memory(options, b, is_function(spec) || options.solver.preconditioner.is_operator());
  const auto checks = checks_of(options.on_failure);
  a->check_parameters(gpu::may_run_kernel(b, options.solver) ? Checks::kHost : checks);
  bool looks_at_product = false;
  if (!spec.transposed) {  // an adjoint solve follows one
    a->check_null_spaces(b);
    looks_at_product = is_function(spec) && refuse_nonlinear_product(spec, b);
  }
  const auto& s = options.solver;
  auto rhs = b;
  if (spec.transposed && is_singular(spec)) rhs = options.cotangent_is_in_range ? a->project(b) : reachable_part(*a, b);
  const bool may_wait = waits_for_report(options);
  auto result = solve(*a, rhs,
                      {.solver = s,
                       .x0 = x0,
                       .whole_cycles = options.backward == Backward::kUnrolled,
                       .may_wait = may_wait,
                       .checks = checks,
                       .report_apart = options.report_apart,
                       .hierarchy = options.hierarchy.get()});
  auto& info = result.info;
  if (spec.transposed && options.adjoint_log != 0) adjoint_log::write(options.adjoint_log, info);
  const SolveRole role{spec, s, spec.transposed, x0};
  report_failures(role, *a, b, info, options.on_failure);
  if (options.on_failure == OnFailure::kRaise || options.on_failure == OnFailure::kWarn)
    warn_of_uneven_rows(role, *a, rhs, result, /*looks_at_channels=*/!options.channels_are_components);
  if (looks_at_product) warn_of_nonlinear_product(spec, b, result.u, info.residual);
  for (auto* part : info.parts())
    if (part->device() != b.device()) *part = part->to(b.device());
  return result;
}

OperatorSpec matrix(const at::Tensor& values) {
  const bool sparse = values.layout() == at::kSparseCsr;
  TORCH_CHECK_VALUE(sparse || values.layout() == at::kStrided,
                    "linear_solve: A must be a dense or sparse CSR tensor, got ", values.layout());
  TORCH_CHECK_VALUE((values.dim() == 2 || values.dim() == 3) && values.sym_size(-1) == values.sym_size(-2),
                    "linear_solve: A must have shape (n, n) or (batch, n, n), got ", values.sym_sizes());
  if (!sparse) return {"dense", {}, {}, {values}};
  const auto crow = values.crow_indices();
  TORCH_CHECK_VALUE(crow.sym_size(-1) == values.sym_size(-1) + 1, "linear_solve: a CSR matrix of ", values.sym_size(-1),
                    " rows needs a crow of one more, got ", crow.sym_size(-1));
  return {"csr", {}, {}, {crow, values.col_indices(), values.values()}};
}

OperatorSpec csr_matrix(const at::Tensor& crow, const at::Tensor& col, const at::Tensor& values) {
  TORCH_CHECK_VALUE(crow.dim() == 1 && crow.numel() > 0 && col.dim() == 1 && (values.dim() == 1 || values.dim() == 2) &&
                        values.size(-1) == col.numel(),
                    "csr_matrix: crow must have shape (n + 1,), col (nnz,) and values (nnz,) or (batch, nnz), got ",
                    crow.sizes(), ", ", col.sizes(), " and ", values.sizes());
  OperatorSpec a{"csr", {}, {}, {crow, col, values}};
  make_operator(a);  // looks at the rest
  return a;
}

namespace {
/// torch.jit.trace has no way to write down the options of a solve, and would fail without saying of what.
void refuse_trace(const c10::OperatorHandle&, torch::jit::Stack*) {
  TORCH_CHECK_TYPE(false, "torch.jit.trace cannot record a solve of prdp_torch; take torch.export or torch.compile");
}
}  // namespace

TORCH_LIBRARY_FRAGMENT(prdp, m) { m.def(kSchema, {at::Tag::pt2_compliant_tag}); }
TORCH_LIBRARY_IMPL(prdp, CompositeExplicitAutograd, m) { m.impl("linear_solve", static_cast<Signature*>(solve_op)); }
TORCH_LIBRARY_IMPL(prdp, Meta, m) { m.impl("linear_solve", static_cast<Signature*>(fake_op)); }
TORCH_LIBRARY_IMPL(prdp, Autograd, m) { m.impl("linear_solve", static_cast<Signature*>(autograd_op)); }
TORCH_LIBRARY_IMPL(prdp, Tracer, m) {
  for (const char* op : {"linear_solve", "step", "rollout"})
    m.impl(op, torch::CppFunction::makeFromBoxedFunction<&refuse_trace>());
}

}  // namespace prdp
