#include "prdp/solvers/first_result.h"

#include <ATen/core/grad_mode.h>

#include "prdp/operators/tensors.h"

namespace prdp::gpu {

Trust trust_by(const Operator& a, const at::Tensor& b, const SolveResult& result) {
  constexpr double share = 0.25, roundings = 200.0, least = 1e-15, most = 1e15;
  const at::NoGradGuard no_grad;
  const auto norm = [](const at::Tensor& v) { return v.to(at::kDouble).flatten(1).norm(2, 1); };
  const auto size = norm(b), whole = norm(a.project(b)), u = norm(result.u);
  const auto found = norm(a.project(b - a.apply(result.u))) / whole;
  const auto& status = result.info.status;
  const auto told = result.info.residual.to(at::kDouble);
  const auto rounding = roundings * epsilon_of(b) * (a.norm().to(at::kDouble).reshape({-1}) * u / whole + 1.0);
  const auto judged = (status >= static_cast<int64_t>(SolveStatus::kStagnated)) & (size > least) & (size < most) &
                      (u < most) & (whole > 1e-3 * size);
  const auto wrong = judged & ((found - told).abs() <= share * told + rounding).logical_not();
  if (wrong.any().item<bool>()) return Trust::kNone;
  return judged.any().item<bool>() ? Trust::kGood : Trust::kUnknown;
}

}  // namespace prdp::gpu
