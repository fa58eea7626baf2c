#include "prdp/solvers/solve_direct.h"

#include <ATen/core/grad_mode.h>

#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/prepared_batch.h"

namespace prdp {

namespace {

bool is_for(const at::Tensor& b, const SolveRequest& request) {
  const auto& solver = request.solver;
  return !b.is_cpu() && b.numel() > 0 && traits(solver.method).is_direct && solver.rtol > 0.0 &&
         solver.max_iter.maybe_as_int().value_or(0) >= 1 && request.guarded && !request.caps;
}

}  // namespace

std::optional<SolveResult> solve_direct_at_once(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  if (!is_for(b, request)) return std::nullopt;
  const at::NoGradGuard no_grad;
  const auto batch = prepare_batch(a, b, request);
  const auto x = a.solve_directly(batch.rhs);
  const auto r = a.project(batch.rhs - a.apply(x));
  auto u = a.project_solution(x) / batch.scale;
  const auto number = [&](const at::Tensor& t) { return t.flatten().to(b.scalar_type()); };
  const auto host =
      at::stack({number(batch.status), number(batch.inconsistent), number(dot_in_order(batch.rhs, batch.rhs)),
                 number(dot_in_order(r, r)), number(largest_magnitude(u))})
          .to(at::kCPU, at::kDouble);
  const int64_t samples = b.size(0);
  const auto status = host[0].to(at::kLong), inconsistent = host[1], b2 = host[2], r2 = host[3], largest = host[4];
  const auto solved = status.eq(static_cast<int64_t>(SolveStatus::kMaxIter))
                          .logical_and(inconsistent.eq(0))
                          .logical_and(r2 <= b2 * (request.solver.rtol * request.solver.rtol))
                          .logical_and(largest.isfinite())
                          .logical_and(largest >= limits_of(b).least_normal);
  const auto zero = status.eq(static_cast<int64_t>(SolveStatus::kConverged));
  if (!solved.logical_or(zero).all().item<bool>()) return std::nullopt;
  if (zero.any().item<bool>()) u = at::where(per_sample(batch.takes_part, b), u, at::zeros_like(u));
  const auto once = solved.to(at::kLong), none = at::zeros({samples}, b.scalar_type());
  const auto residual = at::where(zero, 0.0, (r2 / b2).sqrt()).to(b.scalar_type());
  const auto converged = at::full({samples}, static_cast<int64_t>(SolveStatus::kConverged), at::kLong);
  return SolveResult{u.contiguous(), {once, residual, converged, once.clone(), none}};
}

}  // namespace prdp
