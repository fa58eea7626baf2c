#include "prdp/solvers/first_result.h"

#include <ATen/core/grad_mode.h>

#include "prdp/operators/tensors.h"

namespace prdp::gpu {

namespace {

Trust trust_by_samples(const Operator& a, const at::Tensor& b, const at::Tensor& solution, const at::Tensor& residual) {
  constexpr double share = 0.25, roundings = 200.0, least = 1e-15, most = 1e15;
  const auto norm = [](const at::Tensor& v) { return v.to(at::kDouble).flatten(1).norm(2, 1); };
  const auto size = norm(b), whole = norm(a.project(b)), u = norm(solution);
  const auto found = norm(a.project(b - a.apply(solution))) / whole;
  const auto told = residual.to(at::kDouble);
  const auto rounding = roundings * epsilon_of(b) * (a.norm().to(at::kDouble).reshape({-1}) * u / whole + 1.0);
  const auto judged = (size > least) & (size < most) & (u < most) & (whole > 1e-3 * size);
  const auto wrong = judged & ((found - told).abs() <= share * told + rounding).logical_not();
  if (wrong.any().item<bool>()) return Trust::kNone;
  return judged.any().item<bool>() ? Trust::kGood : Trust::kUnknown;
}

}  // namespace

Trust trust_by(const Operator& a, const at::Tensor& b, const SolveResult& result) {
  const at::NoGradGuard no_grad;
  // Tensor operations may not be able to read the A of others.
  const auto index = (result.info.status >= static_cast<int64_t>(SolveStatus::kStagnated)).nonzero().flatten();
  if (index.numel() == 0) return Trust::kUnknown;
  const auto chosen = a.select(index);
  if (!chosen) return Trust::kUnknown;
  return trust_by_samples(*chosen, b.index_select(0, index), result.u.index_select(0, index),
                          result.info.residual.index_select(0, index));
}

}  // namespace prdp::gpu
