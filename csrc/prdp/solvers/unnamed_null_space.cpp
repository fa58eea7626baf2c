#include "prdp/solvers/unnamed_null_space.h"

#include <ATen/core/grad_mode.h>

#include <cmath>

#include "prdp/operators/apply_on_loops.h"
#include "prdp/operators/probes.h"
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
  const auto whole = sample_norms(channels);
  const auto part = sums / std::sqrt(static_cast<double>(channels.size(-1)));
  return at::where(part <= subnormal_rounding(scale, v), 0.0, part / whole);
}

/// In fewer products than kFewProducts, rounding has hardly grown along a null space, unless A has few eigenvalues and
/// the solve stagnates. After kManyProducts, those that tell whether there is one cost little beside the solve.
constexpr int64_t kFewProducts = 32, kManyProducts = 256;

/// Whether rounding may grow in few products.
bool rounding_grows_fast(const Solver& solver) {
  const auto& m = solver.preconditioner;
  return solver.method == Method::kMultigrid || (m && !m.is_diagonal()) || traits(solver.method).is_direct;
}

/// The samples that ended unsolved, after many products or worse than zero, (batch,); undefined if there is none. On
/// another device every sample is taken to have had its max_iter: nobody waits to read what it had.
at::Tensor suspects_of(const SolveInfo& info, const SolveRequest& request) {
  const auto& solver = request.solver;
  if (!info.status.is_cpu()) {
    const int64_t products = solver.max_iter.expect_int() * traits(solver.method).products;
    const auto is = [&](SolveStatus of) { return info.status.eq(static_cast<int64_t>(of)); };
    auto unsolved = is(SolveStatus::kMaxIter).logical_or(is(SolveStatus::kStagnated));
    if (!traits(solver.method).is_direct)  // where u has grown
      unsolved = unsolved.logical_or(is(SolveStatus::kBreakdown).logical_and(info.iterations.eq(0)));
    const bool worked = rounding_grows_fast(solver) || products >= kFewProducts;
    return !worked || (request.may_wait && !unsolved.any().item<bool>()) ? at::Tensor() : unsolved;
  }
  const int64_t batch = info.status.size(0);
  const auto* status = info.status.const_data_ptr<int64_t>();
  const auto* products = info.operator_applications.const_data_ptr<int64_t>();
  const auto* iterations = info.iterations.const_data_ptr<int64_t>();
  const auto is_above_b = [&](int64_t i) {
    return info.residual.scalar_type() == at::kFloat ? info.residual.const_data_ptr<float>()[i] > 1.0F
                                                     : info.residual.const_data_ptr<double>()[i] > 1.0;
  };
  at::Tensor suspects;
  for (int64_t i = 0; i < batch; ++i) {
    const auto ended = static_cast<SolveStatus>(status[i]);
    const bool has_grown = ended == SolveStatus::kBreakdown && !traits(solver.method).is_direct && iterations[i] == 0;
    if (!is_unsolved(ended) && !has_grown) continue;
    const bool may_have_grown =
        ended == SolveStatus::kStagnated || rounding_grows_fast(solver) || products[i] >= kFewProducts || is_above_b(i);
    if (!may_have_grown) continue;
    if (!suspects.defined()) suspects = at::zeros({batch}, at::kBool);
    suspects.mutable_data_ptr<bool>()[i] = true;
  }
  return suspects;
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

at::Tensor maps_constant_to_zero(const Operator& a, const at::Tensor& b, bool transposed, bool jointly) {
  const auto sizes = row_sizes(a, b, transposed), channels = by_channel(b);
  const auto ones =
      jointly ? at::ones_like(b) : in_each_channel(at::ones({channels.size(-1)}, b.options()), channels).reshape_as(b);
  const auto constant = apply_on_loops(a, ones, transposed).to(at::kDouble);
  const auto share = at::where(sizes.gt(0), constant.abs() / sizes, constant.ne(0).to(at::kDouble));
  return share.flatten(1).square().mean(1).sqrt() <= 32.0 * epsilon_of(b);
}

void mark_inconsistent_constants(const Operator& a, const at::Tensor& b, const SolveRequest& request,
                                 SolveResult& result) {
  if (!request.guarded || !a.may_be_singular()) return;
  auto& info = result.info;
  auto suspects = suspects_of(info, request);
  if (!suspects.defined()) return;
  const at::NoGradGuard no_grad;
  const auto none_left = [&] { return info.status.is_cpu() && !suspects.any().item<bool>(); };
  const auto constant_share = [&](const at::Tensor& v) { return constant_shares(v).to(info.status.device()); };
  const auto residual = info.residual.to(at::kDouble);
  // No u takes the constant part of b off the residual. A half leaves room for rounding.
  const auto share_of_b = constant_share(b.detach());
  suspects = suspects & (share_of_b > 64.0 * epsilon_of(b)) & (residual >= 0.5 * share_of_b);
  if (none_left()) return;
  if (!traits(request.solver.method).is_direct) {
    // The products that tell it are dear beside few others. There, u must look as if it had grown along a constant, or
    // the solve must have gone wrong.
    suspects = suspects & ((info.operator_applications >= kManyProducts) |
                           info.status.eq(static_cast<int64_t>(SolveStatus::kStagnated)) |
                           info.status.eq(static_cast<int64_t>(SolveStatus::kBreakdown)) | (residual > 1.0) |
                           constant_share(result.u).le(0.9).logical_not());
    if (none_left()) return;
  }
  const auto found =
      suspects & maps_constant_to_zero(a, b, /*transposed=*/true, /*jointly=*/true).to(suspects.device());
  info.status = info.status.masked_fill(found, static_cast<int64_t>(SolveStatus::kInconsistent));
  info.floor = floor_of(info.floor, info.status);
}

}  // namespace prdp
