#include "prdp/autograd/solve_vjp.h"

#include <ATen/TensorSubclassLikeUtils.h>
#include <ATen/core/grad_mode.h>

#include <algorithm>

#include "prdp/autograd/adjoint_log.h"
#include "prdp/autograd/finite_rows.h"
#include "prdp/autograd/healthy_tensors.h"
#include "prdp/autograd/solve_jvp.h"
#include "prdp/autograd/unrolled_vjp.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/report_failures.h"
#include "prdp/solvers/solve_on_gpu.h"

namespace prdp {

at::Tensor without_failed(const at::Tensor& derivative, const at::Tensor& status, OnFailure on_failure) {
  if (on_failure == OnFailure::kRaise) return derivative;
  const bool all_failures = on_failure == OnFailure::kZeroGrad;
  if (status.is_cpu() && !at::isTensorSubclassLike(status)) {  // numbers that can be read
    const auto read = status.accessor<int64_t, 1>();
    bool any = false;
    for (int64_t i = 0; i < read.size(0); ++i) {
      const auto s = static_cast<SolveStatus>(read[i]);
      any = any || (all_failures ? is_failure(s) : is_refused(s));
    }
    if (!any) return derivative;
  }
  return cleared(derivative, all_failures ? is_failure(status) : is_refused(status));
}

namespace {

/// Those of the adjoint solve, by its own limits where it has some.
SolveOptions options_of_adjoint(SolveOptions o) {
  o.solver.max_iter = o.adjoint_max_iter.value_or(o.solver.max_iter);
  o.solver.rtol = o.adjoint_rtol.value_or(o.solver.rtol);
  // In a compiled graph rtol is a symbol, traced_rtol, which counts before the number. A tolerance of the adjoint's
  // own, number or symbol, replaces both; without one the solve's stays.
  if (o.adjoint_rtol || o.traced_adjoint_rtol.is_symbolic()) o.traced_rtol = o.traced_adjoint_rtol;
  o.solver.preconditioner = o.solver.preconditioner.transposed();
  return o;
}

/// Samples whose share of ḡ may leave the range of the dtype, told by the largest numbers of λ and u.
at::Tensor may_overflow(const at::Tensor& lambda, const at::Tensor& u) {
  return sample_maxima(lambda.detach()) * sample_maxima(u.detach()) >
         1e-3 * limits_of(lambda).largest / static_cast<double>(lambda.numel());
}

/// Takes the samples whose ḡ may overflow out of λ and u and marks them, without a look by the host.
void leave_out_overflow_on_device(at::Tensor& lambda, at::Tensor& u, at::Tensor& status) {
  const auto overflowing = may_overflow(lambda, u);
  lambda = cleared(lambda, overflowing);
  u = cleared(u, overflowing);
  status = status.masked_fill(overflowing & (status >= static_cast<int64_t>(SolveStatus::kStagnated)),
                              static_cast<int64_t>(SolveStatus::kOverflow));
}

/// The report where ḡ of the samples that are not `finite` left the range of the dtype.
void report_overflow(SolveInfo& info, const Rows& finite, const OperatorSpec& transpose, const at::Tensor& cotangent,
                     const SolveOptions& options) {
  info.status = info.status.to(at::kCPU, /*non_blocking=*/false, /*copy=*/true);
  auto* status = info.status.mutable_data_ptr<int64_t>();
  for (size_t i = 0; i < finite.size(); ++i)
    if (!finite[i] && !is_failure(static_cast<SolveStatus>(status[i])))
      status[i] = static_cast<int64_t>(SolveStatus::kOverflow);
  info.status = info.status.to(cotangent.device());
  if (options.adjoint_log != 0) adjoint_log::write(options.adjoint_log, info);
  report_failures({transpose, options.solver, /*adjoint=*/true}, *make_operator(transpose), cotangent, info,
                  options.on_failure);
}

/// The products for the tensors of A where the host may look: it sums, looks, and sums again without the samples that
/// overflowed, which lose b̄ as well and are reported.
template <class Products>
std::vector<at::Tensor> products_by_sample(SolveVjp& found, const at::Tensor& lambda, const at::Tensor& u,
                                           const at::Tensor& cotangent, const OperatorSpec& a,
                                           const OperatorSpec& transpose, const SolveOptions& o,
                                           const Products& products_of) {
  const auto healthy = make_operator(with_healthy_tensors(a, not_refused(found.info.status)));
  Rows finite(cotangent.size(0), true);
  auto products =
      finite_sum(finite, [&](const Rows& some) { return products_of(*healthy, only(lambda, some), only(u, some)); });
  if (all(finite)) return products;
  if (auto& b_bar = found.gradients[0]; b_bar.defined()) b_bar = only(lambda, finite);
  report_overflow(found.info, finite, transpose, cotangent, o);
  return products;
}

}  // namespace

SolveVjp implicit_vjp(const at::Tensor& cotangent, const at::Tensor& u, const OperatorSpec& a,
                      const SolveOptions& options, at::IntArrayRef needed, decltype(linear_solve)& adjoint_solve) {
  auto transpose = a;
  transpose.transposed = !a.transposed;
  const auto o = options_of_adjoint(options);
  // Of a singular A, linear_solve_unrecorded() takes the reachable part of a cotangent where it solves with Aᵀ. The
  // derivative of an adjoint solve solves with A: the part is taken here.
  const bool is_second = a.transposed && is_singular(a);
  const auto rhs = is_second ? reachable_part(*make_operator(transpose), cotangent) : cotangent;
  auto [lambda, info] = adjoint_solve(transpose, rhs, o, /*x0=*/{});
  if (o.on_failure == OnFailure::kZeroGrad) lambda = without_failed(lambda, info.status, o.on_failure);

  SolveVjp found{std::vector<at::Tensor>(needed.size()), std::move(info)};
  if (needed[0]) found.gradients[0] = lambda;
  const bool needs_a = std::find(needed.begin() + 1, needed.end(), 1) != needed.end();
  if (!u.defined() || !needs_a) return found;
  const auto products_of = [&](const Operator& op, const at::Tensor& of_lambda, const at::Tensor& of_u) {
    auto products = op.product_rule(of_lambda, of_u);
    for (size_t i = 0; i < products.size(); ++i)
      products[i] = needed[i + 1] && products[i].defined() ? products[i].neg() : at::Tensor();
    return products;
  };
  std::vector<at::Tensor> products;
  // ḡ sums over samples, and an overflow must stay with its own. How samples that overflow are left out:
  //   on a GPU that nobody waits for   by a bound from the largest numbers of λ and u, on the device
  //   of tensors without numbers       not at all; only refused samples are replaced
  //   else                             sum, look, and sum again without them
  const bool has_numbers = !at::isTensorSubclassLike(lambda) && !at::isTensorSubclassLike(u);  // to look at
  if (has_numbers && !waits_for_report(o) && gpu::may_run_kernel(cotangent, o.solver) && !in_torch_func()) {
    auto kept_u = u;
    leave_out_overflow_on_device(lambda, kept_u, found.info.status);
    if (needed[0]) found.gradients[0] = lambda;
    if (o.adjoint_log != 0) adjoint_log::write(o.adjoint_log, found.info);
    products = products_of(*make_operator(a), lambda, kept_u);
  } else if (!has_numbers) {
    const bool may_be_refused = o.on_failure != OnFailure::kRaise;
    const auto healthy = may_be_refused ? with_ones_where_refused(a, found.info.status) : a;
    products = products_of(*make_operator(healthy), lambda, u);
  } else {
    products = products_by_sample(found, lambda, u, cotangent, a, transpose, o, products_of);
  }
  std::copy(products.begin(), products.end(), found.gradients.begin() + 1);
  return found;
}

SolveVjp solve_vjp(at::Tensor cotangent, const Solved& solved, const OperatorSpec& a, const SolveOptions& options,
                   at::IntArrayRef needed, decltype(linear_solve)& adjoint_solve) {
  cotangent = without_failed(cotangent, solved.status, options.on_failure);
  if (options.backward == Backward::kImplicit)
    return implicit_vjp(cotangent, solved.u, a, options, needed, adjoint_solve);
  // With create_graph=True the derivative is itself recorded; else it is one op, as a compiled graph and
  // torch.func need it.
  bool recorded = at::GradMode::is_enabled() && !in_torch_func() && !has_tangent(cotangent) && !has_tangent(solved.b) &&
                  !any_tangent(a.tensors);
  // `needed` is of the forward pass. An input that has ceased to require a gradient belonged to a transform that ended.
  for (size_t i = 0; i < needed.size(); ++i)
    if (needed[i]) recorded = recorded && (i == 0 ? solved.b : a.tensors[i - 1]).requires_grad();
  const auto vjp = recorded ? unrolled_vjp_recorded : unrolled_vjp;
  return vjp(cotangent, solved, a, options, needed);
}

}  // namespace prdp
