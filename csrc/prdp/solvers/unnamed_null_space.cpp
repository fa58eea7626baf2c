#include "prdp/solvers/unnamed_null_space.h"

#include <ATen/core/grad_mode.h>

#include <cmath>
#include <vector>

#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/prepared_batch.h"

namespace prdp {

namespace {

/// The share of each sample of v that is constant in a channel, (batch,) in double; 0 where it may be the rounding of v
/// to the least numbers of its dtype.
at::Tensor constant_shares(const at::Tensor& v) {
  const auto scale = power_of_two_scale(largest_magnitude(v));  // squares of small numbers are zero
  const auto channels = by_channel(v * per_sample(scale, v));
  const auto sums = channels.sum(-1, /*keepdim=*/false, at::kDouble).view({v.size(0), -1}).norm(2, 1);
  const auto whole = at::linalg_vector_norm(channels.flatten(1), 2, 1, /*keepdim=*/false, at::kDouble);
  const auto part = sums / std::sqrt(static_cast<double>(channels.size(-1)));
  return at::where(part <= rounding_of_least_numbers(scale, v), 0.0, part / whole);
}

double residual_of_sample(const at::Tensor& residuals, int64_t sample) {
  return residuals.scalar_type() == at::kFloat ? residuals.const_data_ptr<float>()[sample]
                                               : residuals.const_data_ptr<double>()[sample];
}

constexpr auto kMaxIter = static_cast<int64_t>(SolveStatus::kMaxIter);
constexpr auto kStagnated = static_cast<int64_t>(SolveStatus::kStagnated);
constexpr int64_t kFewProducts = 32, kManyProducts = 256;

/// Whether rounding may have grown, after so many products.
bool worked_for_long(const Solver& solver, int64_t products) {
  const auto& m = solver.preconditioner;
  const bool has_cycles = solver.method == Method::kMultigrid || (m && !m.is_diagonal());
  return products >= kFewProducts || has_cycles || traits(solver.method).is_direct;
}

}  // namespace

at::Tensor row_sizes(const Operator& a, const at::Tensor& b, bool transposed) {
  const auto channels = by_channel(b);
  const auto squares = at::arange(1, channels.size(-1) + 1, b.options().dtype(at::kDouble)).square();
  const auto size = [&](const at::Tensor& v) {
    return apply_on_loops(a, v.to(b.scalar_type()).expand_as(channels).reshape_as(b), transposed).to(at::kDouble).abs();
  };
  return at::maximum(size(squares.sin()), size(squares.cos()));
}

at::Tensor maps_constant_to_zero(const Operator& a, const at::Tensor& b, bool transposed) {
  const auto sizes = row_sizes(a, b, transposed);
  const auto constant = apply_on_loops(a, at::ones_like(b), transposed).to(at::kDouble);
  const auto share = at::where(sizes.gt(0), constant.abs() / sizes, constant.ne(0).to(at::kDouble));
  return share.flatten(1).square().mean(1).sqrt() <= 32.0 * epsilon_of(b);
}

namespace {

/// What is found of a report on the host, at the end of the next function, as tensor operations on its device.
void find_inconsistent_constants_there(const Operator& a, const at::Tensor& b, const Solver& solver,
                                       SolveResult& result) {
  // Every sample takes as many products, and a few more.
  const int64_t products = solver.max_iter.expect_int() * traits(solver.method).products;
  if (!worked_for_long(solver, products)) return;
  const at::NoGradGuard no_grad;
  auto& info = result.info;
  const auto residual = info.residual.to(at::kDouble), of_b = constant_shares(b.detach());
  auto suspects = info.status.eq(static_cast<int64_t>(SolveStatus::kMaxIter))
                      .logical_or(info.status.eq(static_cast<int64_t>(SolveStatus::kStagnated)));
  suspects = suspects & (of_b > 64.0 * epsilon_of(b)) & (residual >= 0.5 * of_b);
  if (products < kManyProducts)
    suspects = suspects & (info.status.eq(static_cast<int64_t>(SolveStatus::kStagnated)) | (residual > 1.0) |
                           (constant_shares(result.u) > 0.9));
  const auto found = suspects & maps_constant_to_zero(a, b, /*transposed=*/true);
  info.status = info.status.masked_fill(found, static_cast<int64_t>(SolveStatus::kInconsistent));
  info.floor = floor_of(info.floor, info.status);
}

}  // namespace

void find_inconsistent_constants(const Operator& a, const at::Tensor& b, const SolveRequest& request,
                                 SolveResult& result) {
  if (!request.guarded || !a.may_be_singular()) return;
  const auto& solver = request.solver;
  if (!result.info.status.is_cpu()) {
    const auto& status = result.info.status;
    if (request.may_wait && !status.eq(kMaxIter).logical_or(status.eq(kStagnated)).any().item<bool>()) return;
    return find_inconsistent_constants_there(a, b, solver, result);
  }
  auto& info = result.info;
  auto* status = info.status.mutable_data_ptr<int64_t>();
  const auto* products = info.operator_applications.const_data_ptr<int64_t>();
  const auto status_of = [&](int64_t i) { return static_cast<SolveStatus>(status[i]); };
  std::vector<int64_t> suspects;
  const auto is_worse_than_zero = [&](int64_t i) { return residual_of_sample(info.residual, i) > 1.0; };
  for (int64_t i = 0; i < b.size(0); ++i)
    if (is_unsolved(status_of(i)) && (worked_for_long(solver, products[i]) || is_worse_than_zero(i)))
      suspects.push_back(i);
  if (suspects.empty()) return;

  const at::NoGradGuard no_grad;
  const auto residuals = info.residual.to(at::kCPU, at::kDouble);
  const auto* residual = residuals.const_data_ptr<double>();
  const auto of_b = constant_shares(b.detach()).to(at::kCPU);
  // No u takes the constant part of b off the residual. A half leaves room for rounding.
  std::erase_if(suspects, [&](int64_t i) {
    const double share = of_b.const_data_ptr<double>()[i];
    return !(share > 64.0 * epsilon_of(b) && residual[i] >= 0.5 * share);
  });
  if (suspects.empty()) return;
  const auto of_u = constant_shares(result.u).to(at::kCPU);
  std::erase_if(suspects, [&](int64_t i) {
    if (products[i] >= kManyProducts || traits(solver.method).is_direct) return false;
    // The products that tell it are dear here, so u has to look like no truncated solution.
    const double share = of_u.const_data_ptr<double>()[i];
    return status_of(i) != SolveStatus::kStagnated && residual[i] <= 1.0 && share <= 0.9;
  });
  if (suspects.empty()) return;
  const auto found = maps_constant_to_zero(a, b, /*transposed=*/true).to(at::kCPU);
  for (const int64_t i : suspects)
    if (found.const_data_ptr<bool>()[i]) status[i] = static_cast<int64_t>(SolveStatus::kInconsistent);
  info.floor = floor_of(info.floor, info.status);
}

}  // namespace prdp
