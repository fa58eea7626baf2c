#include "prdp/solvers/first_result.h"

#include <ATen/core/grad_mode.h>

#include "prdp/operators/tensors.h"

namespace prdp::gpu {

namespace {

/// Whether the residuals that the kernel reports are those of its solutions, up to a quarter and to rounding. A sample
/// says nothing where a number may leave the range of float32, or little of b is in the range of A.
Trust trust_by_residuals(const Operator& a, const at::Tensor& b, const at::Tensor& solution,
                         const at::Tensor& residual) {
  constexpr double share = 0.25, roundings = 200.0, least = 1e-15, most = 1e15, least_share_in_range = 1e-3;
  const auto size = sample_norms(b), projected_norm = sample_norms(a.project(b)), u = sample_norms(solution);
  const auto recomputed = sample_norms(a.project(b - a.apply(solution))) / projected_norm;
  const auto reported = residual.to(at::kDouble);
  const auto rounding = roundings * epsilon_of(b) * (a.norm().to(at::kDouble).reshape({-1}) * u / projected_norm + 1.0);
  const auto tells = (size > least) & (size < most) & (u < most) & (projected_norm > least_share_in_range * size);
  const auto wrong = tells & ((recomputed - reported).abs() <= share * reported + rounding).logical_not();
  if (wrong.any().item<bool>()) return Trust::kNone;
  return tells.any().item<bool>() ? Trust::kGood : Trust::kUnknown;
}

/// For samples that the kernel reports as not finite or with a zero diagonal: solves them without kernels. kNone if one
/// ends well there.
Trust trust_by_solving_again(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  try {
    a.check_parameters(Checks::kAll);
  } catch (const c10::Error&) {  // the host refuses A: tensor operations could read beyond it
    return Trust::kUnknown;
  }
  const WithoutKernels by_others;
  const auto status = solve(a, b, request).info.status;
  return status.ge(static_cast<int64_t>(SolveStatus::kStagnated)).any().item<bool>() ? Trust::kNone : Trust::kUnknown;
}

}  // namespace

Trust verify_first_result(const Operator& a, const at::Tensor& b, const SolveRequest& request,
                          const SolveResult& result) {
  const at::NoGradGuard no_grad;
  const auto& info = result.info;
  // Compared by status, as tensor operations may not be able to read an A that was refused.
  const auto judge_samples = [&](const at::Tensor& index, const auto& judge) {
    const auto chosen = index.numel() > 0 ? a.select(index) : nullptr;
    return chosen ? judge(*chosen, b.index_select(0, index)) : Trust::kUnknown;
  };
  const auto where = [](const at::Tensor& mask) { return mask.nonzero().flatten(); };
  const auto is = [&](SolveStatus status) { return info.status == static_cast<int64_t>(status); };
  const auto ended_well = where(info.status >= static_cast<int64_t>(SolveStatus::kStagnated));
  const auto trust = judge_samples(ended_well, [&](const Operator& of, const at::Tensor& rhs) {
    return trust_by_residuals(of, rhs, result.u.index_select(0, ended_well), info.residual.index_select(0, ended_well));
  });
  if (trust == Trust::kNone || ended_well.numel() == b.size(0)) return trust;
  const auto not_finite = where(is(SolveStatus::kOverflow) | is(SolveStatus::kZeroDiagonal) |
                                is(SolveStatus::kNonfiniteInput) | is(SolveStatus::kNonfiniteOperator));
  const auto of_failed = judge_samples(not_finite, [&](const Operator& of, const at::Tensor& rhs) {
    const auto x0 = request.x0.defined() ? request.x0.index_select(0, not_finite) : at::Tensor();
    return trust_by_solving_again(of, rhs, {.solver = request.solver, .x0 = x0});
  });
  return of_failed == Trust::kNone ? of_failed : trust;
}

}  // namespace prdp::gpu
