#include "prdp/autograd/unrolled_vjp.h"

#include <ATen/core/dispatch/Dispatcher.h>
#include <torch/csrc/autograd/autograd.h>
#include <torch/library.h>

#include <limits>

#include "prdp/autograd/adjoint_log.h"
#include "prdp/autograd/linear_solve.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/solve.h"

namespace prdp {

namespace {

constexpr const char* kSchema =
    "unrolled_vjp(Tensor cotangent, Tensor b, Tensor[] tensors, int[] needed, str kind, "
    "int[] shape, float[] parameters, bool transposed, str solver, SymInt max_iter, float rtol, int restart, "
    "Tensor iterations, Tensor status, int checkpoint_every=0, int adjoint_log=0) -> "
    "(Tensor[] gradients, Tensor operator_applications)";
using Outputs = std::tuple<std::vector<at::Tensor>, at::Tensor>;

/// b = 0 is solved in no iterations, yet the map has a derivative there: A⁻ᵀ by the same method and
/// budget, which for linear methods is the derivative of all max_iter iterations. Adds it to b̄.
void add_derivative_at_zero(UnrolledVjp& found, const at::Tensor& cotangent, const UnrolledSolve& solve,
                            at::IntArrayRef needed) {
  const auto at_zero = solve.iterations.eq(0).logical_and(
      solve.status.eq(static_cast<int64_t>(SolveStatus::kConverged)));
  if (!needed[0] || !at_zero.any().item<bool>()) return;
  auto a = solve.a;
  a.transposed = !a.transposed;
  SolveOptions options{solve.solver, Backward::kImplicit};
  options.on_failure = OnFailure::kReturn;
  const auto [lambda, info] = linear_solve(a, cotangent * per_sample(at_zero, cotangent), options);
  add_to(found.gradients[0], lambda);
  found.operator_applications = found.operator_applications + info.operator_applications * at_zero;
}

void log_sweeps(const UnrolledVjp& found, const UnrolledSolve& solve, const at::Tensor& b, int64_t log) {
  if (log != 0) adjoint_log::write(log, unrolled_info(found, solve, b));
}

Outputs vjp_kernel(const at::Tensor& cotangent, const at::Tensor& b, at::TensorList tensors,
                   at::IntArrayRef needed, c10::string_view kind, at::IntArrayRef shape,
                   at::ArrayRef<double> parameters, bool transposed, c10::string_view solver,
                   c10::SymInt max_iter, double rtol, int64_t restart, const at::Tensor& iterations,
                   const at::Tensor& status, int64_t checkpoint_every, int64_t log) {
  const at::NoGradGuard no_grad;
  UnrolledSolve unrolled{{std::string(kind), shape.vec(), parameters.vec(), {}, transposed},
                         {method_from_name(solver), max_iter, rtol, restart},
                         iterations,
                         status,
                         checkpoint_every};
  for (const auto& t : tensors) unrolled.a.tensors.push_back(t.detach());
  make_operator(unrolled.a)->check_parameters();
  const auto rhs = b.detach();
  const bool for_b_alone = std::count(needed.begin(), needed.end(), 1) == 1 && needed[0] == 1;
  UnrolledVjp found;
  const auto method = unrolled.solver.method;
  if ((method == Method::kJacobi || method == Method::kChebyshev) && for_b_alone) {
    // K sweeps from zero are u = p(I - D⁻¹A) D⁻¹ b with a polynomial p; transposed, that is K sweeps with Aᵀ.
    auto transpose = unrolled.a;
    transpose.transposed = !transposed;
    const SolveRequest request{method, 0, 0.0, restart, iterations};
    const auto [b_bar, info] = prdp::solve(*make_operator(transpose), cotangent, request);
    found = {std::vector<at::Tensor>(needed.size()), info.operator_applications};
    found.gradients[0] = b_bar;
  } else if (has_sweep(*make_operator(unrolled.a), unrolled, rhs)) {
    found = sweep_vjp(cotangent, rhs, unrolled, needed);
  } else {
    found = replay_vjp(cotangent, rhs, unrolled, needed);
  }
  found.operator_applications = found.operator_applications.to(b.device());
  add_derivative_at_zero(found, cotangent, unrolled, needed);
  log_sweeps(found, unrolled, rhs, log);

  std::vector<at::Tensor> gradients;
  for (size_t i = 0; i < needed.size(); ++i) {
    if (!needed[i]) continue;
    const auto& g = found.gradients[i];
    gradients.push_back(g.defined() ? g : at::zeros_like(i == 0 ? rhs : tensors[i - 1]));
  }
  return {gradients, found.operator_applications};
}

Outputs fake_kernel(const at::Tensor&, const at::Tensor& b, at::TensorList tensors, at::IntArrayRef needed,
                    c10::string_view, at::IntArrayRef, at::ArrayRef<double>, bool, c10::string_view,
                    c10::SymInt, double, int64_t, const at::Tensor& iterations, const at::Tensor&, int64_t,
                    int64_t) {
  std::vector<at::Tensor> gradients;
  if (needed[0]) gradients.push_back(at::empty_symint(b.sym_sizes(), b.options()));
  for (size_t i = 0; i < tensors.size(); ++i)
    if (needed[i + 1]) gradients.push_back(at::empty_symint(tensors[i].sym_sizes(), tensors[i].options()));
  return {gradients, at::empty_symint(iterations.sym_sizes(), iterations.options())};
}

}  // namespace

SolveInfo unrolled_info(const UnrolledVjp& found, const UnrolledSolve& solve, const at::Tensor& b) {
  const auto none = at::full_symint({b.sym_size(0)}, std::numeric_limits<double>::quiet_NaN(), b.options());
  return {solve.iterations, none, solve.status, found.operator_applications};
}

UnrolledVjp unrolled_vjp(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                         at::IntArrayRef needed, int64_t log) {
  static const auto op = c10::Dispatcher::singleton()
                             .findSchemaOrThrow("prdp::unrolled_vjp", "")
                             .typed<decltype(vjp_kernel)>();
  const auto& a = solve.a;
  const auto [gradients, applications] =
      op.call(cotangent, b, a.tensors, needed, a.kind, a.shape, a.parameters, a.transposed,
              name(solve.solver.method), solve.solver.max_iter, solve.solver.rtol, solve.solver.restart,
              solve.iterations, solve.status, solve.checkpoint_every, log);
  UnrolledVjp found{std::vector<at::Tensor>(needed.size()), applications};
  for (size_t i = 0, next = 0; i < needed.size(); ++i)
    if (needed[i]) found.gradients[i] = gradients[next++];
  return found;
}

UnrolledVjp unrolled_vjp_recorded(const at::Tensor& cotangent, const at::Tensor& b,
                                  const UnrolledSolve& solve, at::IntArrayRef needed, int64_t log) {
  const at::AutoGradMode record(true);
  // Partial derivatives: b and the tensors may be one tensor, or depend on each other further back.
  const auto rhs = at::alias(b);
  auto a = solve.a;
  for (auto& t : a.tensors) t = at::alias(t);
  const auto [u, applications] = solve_recorded(*make_operator(a), rhs, solve.solver, solve.iterations);
  UnrolledVjp found{std::vector<at::Tensor>(needed.size()), 2 * applications};
  std::vector<at::Tensor> inputs;
  for (size_t i = 0; i < needed.size(); ++i)
    if (needed[i]) inputs.push_back(i == 0 ? rhs : a.tensors[i - 1]);
  if (u.requires_grad()) {  // not where no sample took an iteration
    const auto gradients = torch::autograd::grad({u}, inputs, {cotangent}, /*retain_graph=*/true,
                                                 /*create_graph=*/true, /*allow_unused=*/true);
    for (size_t i = 0, next = 0; i < needed.size(); ++i)
      if (needed[i]) found.gradients[i] = gradients[next++];
  }
  add_derivative_at_zero(found, cotangent, solve, needed);
  log_sweeps(found, solve, b, log);
  return found;
}

TORCH_LIBRARY_FRAGMENT(prdp, m) { m.def(kSchema, {at::Tag::pt2_compliant_tag}); }
TORCH_LIBRARY_IMPL(prdp, CompositeExplicitAutograd, m) { m.impl("unrolled_vjp", vjp_kernel); }
TORCH_LIBRARY_IMPL(prdp, Meta, m) { m.impl("unrolled_vjp", fake_kernel); }

}  // namespace prdp
