#include "prdp/solvers/unnamed_null_space.h"

#include <ATen/core/grad_mode.h>

#include <algorithm>
#include <cmath>

#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"

namespace prdp {

namespace {

at::Tensor norm_of_samples(const at::Tensor& v) { return v.to(at::kDouble).flatten(1).norm(2, 1); }

/// The share of each b that is constant in a channel: double, (batch,), on the CPU.
at::Tensor constant_share(const at::Tensor& b) {
  const auto channels = (b.dim() < 3 ? b.unsqueeze(1) : b.flatten(2)).to(at::kDouble);
  const auto constant = channels.sum(-1).norm(2, 1) / std::sqrt(static_cast<double>(channels.size(-1)));
  return (constant / norm_of_samples(b)).to(at::kCPU);
}

/// Whether one more product is little beside what this solver did.
bool worked_hard(const Solver& solver, int64_t products) {
  constexpr int64_t many = 32;
  const auto& m = solver.preconditioner;
  return products >= many || traits(solver.method).is_direct || solver.method == Method::kMultigrid ||
         (m && !m.is_diagonal());
}

}  // namespace

at::Tensor maps_constant_to_zero(const Operator& a, const at::Tensor& b, bool transposed) {
  const auto product = [&](const at::Tensor& v) {
    return norm_of_samples(transposed ? a.apply_transpose(v) : a.apply(v));
  };
  // How large a product can be: that of a vector which changes its sign from point to point.
  const auto alternating = 1.0 - 2.0 * at::arange(b[0].numel(), b.options()).remainder(2.0);
  const auto largest = product(alternating.view_as(b[0]).expand_as(b));
  return product(at::ones_like(b)) <= 16.0 * epsilon_of(b) * largest;
}

void find_inconsistent_constants(const Operator& a, const at::Tensor& b, const SolveRequest& request, SolveInfo& info) {
  if (!request.guarded || !a.may_be_singular()) return;
  auto* status = info.status.mutable_data_ptr<int64_t>();
  const auto* products = info.operator_applications.const_data_ptr<int64_t>();
  const auto unsolved = [&](int64_t i) {
    const auto s = static_cast<SolveStatus>(status[i]);
    return (s == SolveStatus::kMaxIter || s == SolveStatus::kStagnated) && worked_hard(request.solver, products[i]);
  };
  const int64_t batch = b.size(0);
  std::vector<int64_t> suspects;
  for (int64_t i = 0; i < batch; ++i)
    if (unsolved(i)) suspects.push_back(i);
  if (suspects.empty()) return;

  const at::NoGradGuard no_grad;
  const auto share = constant_share(b.detach()), residual = info.residual.to(at::kCPU, at::kDouble);
  const double rounding = 64.0 * epsilon_of(b);
  // No u takes that share off the residual. A half leaves room for rounding.
  const auto explains = [&](int64_t i) {
    const double of_b = share.const_data_ptr<double>()[i];
    return of_b > rounding && residual.const_data_ptr<double>()[i] >= 0.5 * of_b;
  };
  suspects.erase(std::remove_if(suspects.begin(), suspects.end(), [&](int64_t i) { return !explains(i); }),
                 suspects.end());
  if (suspects.empty()) return;
  const auto found = maps_constant_to_zero(a, b, /*transposed=*/true).to(at::kCPU);
  for (const int64_t i : suspects)
    if (found.const_data_ptr<bool>()[i]) status[i] = static_cast<int64_t>(SolveStatus::kInconsistent);
}

}  // namespace prdp
