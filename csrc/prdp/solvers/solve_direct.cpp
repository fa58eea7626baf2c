#include "prdp/solvers/solve_direct.h"

#include <ATen/core/grad_mode.h>

#include <cmath>
#include <numeric>

#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/prepared_batch.h"
#include "prdp/solvers/verdicts.h"

namespace prdp {

namespace {

bool is_single_solve(const at::Tensor& b, const SolveRequest& request) {
  const auto& solver = request.solver;
  return !b.is_cpu() && b.numel() > 0 && traits(solver.method).is_direct && solver.rtol > 0.0 &&
         solver.max_iter.maybe_as_int().value_or(0) >= 1 && request.guarded && !request.caps;
}

SolveResult result_of(const at::Tensor& u, const at::Tensor& zero, const at::Tensor& residual) {
  const auto once = zero.logical_not().to(at::kLong), none = at::zeros(zero.sizes(), u.scalar_type());
  const auto converged = at::full(zero.sizes(), static_cast<int64_t>(SolveStatus::kConverged), at::kLong);
  return {u.contiguous(), {once, at::where(zero, 0.0, residual).to(u.scalar_type()), converged, once.clone(), none}};
}

/// max |t| of each sample, in one operation.
at::Tensor largest_of(const at::Tensor& t) {
  std::vector<int64_t> axes(t.dim() - 1);
  std::iota(axes.begin(), axes.end(), 1);
  return at::linalg_vector_norm(t, INFINITY, axes);
}
at::Tensor square_of(const at::Tensor& t) { return dot_in_order(t, t).view({-1}); }

/// Which samples meet rtol by a u that is neither infinite nor subnormal, from numbers on the host.
at::Tensor meets_rtol(const at::Tensor& r2, const at::Tensor& b2, const at::Tensor& largest_of_u, double rtol,
                      const at::Tensor& b) {
  return r2.le(b2 * (rtol * rtol)) & largest_of_u.isfinite() & largest_of_u.ge(limits_of(b).least_normal);
}

/// Nothing if a sample is out of the ordinary or not solved. b is not scaled, which by powers of two changes no bit
/// where no number leaves the range of the dtype.
std::optional<SolveResult> solve_ordinary(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  constexpr double least = 1e-10, most = 1e10;  // of the largest entry of b
  const auto rhs = a.project(b), x = a.solve_directly(rhs, /*transposed=*/false), u = a.project_solution(x);
  enum Row : int64_t { kLargestOfB, kB2, kResidual2, kLargestOfU, kWhole2, kRemoved2 };
  std::vector<at::Tensor> rows{largest_of(b), square_of(rhs), square_of(a.project(rhs - a.apply(x))), largest_of(u)};
  if (a.needs_projection()) rows.insert(rows.end(), {square_of(b), square_of(b - rhs)});
  const auto host = at::stack(rows).to(at::kCPU, at::kDouble);
  const auto largest = host[kLargestOfB], b2 = host[kB2], r2 = host[kResidual2], largest_of_u = host[kLargestOfU];
  const double rtol = request.solver.rtol;
  auto solved = largest.ge(least) & largest.le(most) & meets_rtol(r2, b2, largest_of_u, rtol, b);
  if (a.needs_projection()) {
    const double bound =
        b.scalar_type() == at::kFloat ? consistency_bound<float>(rtol) : consistency_bound<double>(rtol);
    const auto size_of_b = host[kWhole2].sqrt(), removed = host[kRemoved2].sqrt();
    solved = solved & removed.le(bound * size_of_b) & b2.sqrt().gt(epsilon_of(b) * size_of_b);
  }
  const auto zero = largest.eq(0) & largest_of_u.eq(0);
  if (!(solved | zero).all().item<bool>()) return std::nullopt;
  return result_of(u, zero, (r2 / b2).sqrt());
}

/// The same for any b. Nothing if a sample is not solved.
std::optional<SolveResult> solve_scaled(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  const auto batch = prepare_batch(a, b, request);
  const auto x = a.solve_directly(batch.rhs, /*transposed=*/false);
  const auto r = a.project(batch.rhs - a.apply(x));
  auto u = a.project_solution(x) / batch.scale;
  const auto number = [&](const at::Tensor& t) { return t.flatten().to(b.scalar_type()); };
  enum Row : int64_t { kStatus, kInconsistent, kB2, kResidual2, kLargestOfU };
  const auto host = at::stack({number(batch.status), number(batch.inconsistent), square_of(batch.rhs), square_of(r),
                               number(largest_magnitude(u))})
                        .to(at::kCPU, at::kDouble);
  const auto status = host[kStatus].to(at::kLong), inconsistent = host[kInconsistent];
  const auto b2 = host[kB2], r2 = host[kResidual2], largest_of_u = host[kLargestOfU];
  const auto solved = status.eq(static_cast<int64_t>(SolveStatus::kMaxIter)) & inconsistent.eq(0) &
                      meets_rtol(r2, b2, largest_of_u, request.solver.rtol, b);
  const auto zero = status.eq(static_cast<int64_t>(SolveStatus::kConverged));
  if (!solved.logical_or(zero).all().item<bool>()) return std::nullopt;
  if (zero.any().item<bool>()) u = at::where(per_sample(batch.takes_part, b), u, at::zeros_like(u));
  return result_of(u, zero, (r2 / b2).sqrt());
}

}  // namespace

std::optional<SolveResult> solve_direct_at_once(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  if (!is_single_solve(b, request)) return std::nullopt;
  const at::NoGradGuard no_grad;
  if (auto ordinary = solve_ordinary(a, b, request)) return ordinary;
  return solve_scaled(a, b, request);
}

}  // namespace prdp
