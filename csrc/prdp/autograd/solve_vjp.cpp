#include "prdp/autograd/solve_vjp.h"

#include <ATen/core/grad_mode.h>

#include "prdp/operators/disguises.h"
#include "prdp/autograd/unrolled_vjp.h"
#include "prdp/operators/tensors.h"

namespace prdp {

at::Tensor without_refused(const at::Tensor& derivative, const at::Tensor& status) {
  if (status.is_cpu() && !at::isTensorSubclassLike(status)) {  // numbers that can be read
    const auto read = status.accessor<int64_t, 1>();
    int64_t refused = 0;
    for (int64_t i = 0; i < read.size(0); ++i) refused += is_refused(static_cast<SolveStatus>(read[i]));
    if (refused == 0) return derivative;
  }
  const auto refused = status.eq(static_cast<int64_t>(SolveStatus::kZeroDiagonal))
                           .logical_or(status.le(static_cast<int64_t>(SolveStatus::kNonfiniteInput)));
  return derivative.masked_fill(per_sample(refused, derivative), 0.0);
}

namespace {

/// Aᵀ λ = ū; b̄ = λ; ḡ = -∂⟨λ, A(g) u⟩/∂g. Again differentiable: the solve is the same op.
SolveVjp implicit(const at::Tensor& cotangent, const at::Tensor& u, const OperatorSpec& a,
                  const SolveOptions& options, at::IntArrayRef needed,
                  decltype(linear_solve)& adjoint_solve) {
  auto transpose = a;
  transpose.transposed = !a.transposed;
  auto o = options;
  o.solver.max_iter = o.adjoint_max_iter.value_or(o.solver.max_iter);
  o.solver.rtol = o.adjoint_rtol.value_or(o.solver.rtol);
  auto [lambda, info] = adjoint_solve(transpose, cotangent, o);

  SolveVjp found{std::vector<at::Tensor>(needed.size()), std::move(info)};
  if (needed[0]) found.gradients[0] = lambda;
  if (!u.defined()) return found;
  const auto products = make_operator(a)->product_rule(lambda, u);
  for (size_t i = 0; i < products.size(); ++i)
    if (needed[i + 1] && products[i].defined()) found.gradients[i + 1] = products[i].neg();
  return found;
}

SolveVjp unrolled(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& a,
                  const SolveOptions& options, at::IntArrayRef needed) {
  const UnrolledSolve solve{a, options.solver, solved.iterations, solved.status, options.checkpoint_every};
  // With create_graph=True the derivative is itself recorded; else it is one op, as a compiled graph and
  // torch.func need it.
  bool recorded = at::GradMode::is_enabled() && !in_torch_func() && !has_tangent(cotangent) &&
                  !has_tangent(solved.b) && !any_tangent(a.tensors);
  for (size_t i = 0; i < needed.size(); ++i)  // not where they did so in a transform that has ended
    if (needed[i]) recorded = recorded && (i == 0 ? solved.b : a.tensors[i - 1]).requires_grad();
  const auto vjp = recorded ? unrolled_vjp_recorded : unrolled_vjp;
  auto found = vjp(cotangent, solved.b, solve, needed, options.adjoint_log);
  const auto info = unrolled_info(found, solve, cotangent);
  return {std::move(found.gradients), info};
}

}  // namespace

SolveVjp solve_vjp(at::Tensor cotangent, const Solved& solved, const OperatorSpec& a,
                   const SolveOptions& options, at::IntArrayRef needed,
                   decltype(linear_solve)& adjoint_solve) {
  if (options.on_failure != OnFailure::kRaise) cotangent = without_refused(cotangent, solved.status);
  if (options.backward == Backward::kUnrolled) return unrolled(cotangent, solved, a, options, needed);
  return implicit(cotangent, solved.u, a, options, needed, adjoint_solve);
}

}  // namespace prdp
