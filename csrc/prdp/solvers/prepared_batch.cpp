#include "prdp/solvers/prepared_batch.h"

#include <ATen/TensorSubclassLikeUtils.h>

#include "prdp/operators/tensors.h"
#include "prdp/solvers/batch_loops.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/verdicts.h"

namespace prdp {

namespace {

/// The status of each sample that is settled before iterating, and MAX_ITER of the others.
at::Tensor settle_beforehand(const Operator& a, const Solver& solver, const at::Tensor& b, const at::Tensor& magnitude,
                             const at::Tensor& start_magnitude) {
  const int64_t batch = magnitude.size(0);
  auto status = at::full({batch}, static_cast<int64_t>(SolveStatus::kMaxIter), magnitude.options().dtype(at::kLong));
  const auto nowhere = at::zeros_like(status, at::kBool);
  const auto mark = [&](const at::Tensor& rows, SolveStatus why) {
    // A single number of the CPU, as a plain nu leaves, is an argument there and no copy.
    const auto which = rows.numel() == 1 ? rows.reshape({}) : rows.reshape({-1});
    status = status.masked_fill(nowhere.logical_or(which), static_cast<int64_t>(why));
  };
  // The last mark holds: the order is that of the CPU loops, from the end.
  mark(magnitude.eq(0), SolveStatus::kConverged);
  if (divides_by_diagonal(solver)) {
    const auto zero = a.diagonal().eq(0);
    mark(zero.dim() == b.dim() ? zero.flatten(1).any(1) : zero.any(), SolveStatus::kZeroDiagonal);
  }
  mark(a.nonfinite_samples(b), SolveStatus::kNonfiniteOperator);
  if (start_magnitude.defined()) mark(start_magnitude.isfinite().logical_not(), SolveStatus::kNonfiniteInput);
  mark(magnitude.isfinite().logical_not(), SolveStatus::kNonfiniteInput);
  return status;
}

/// Of which samples' right-hand sides so much lies outside the range of a singular operator: more than rtol and than
/// their `rounding`; all.
struct OutsideRange {
  at::Tensor some, all;
};
OutsideRange outside_range(const at::Tensor& b, const at::Tensor& projected, double rtol, const at::Tensor& rounding) {
  const double bound = b.scalar_type() == at::kFloat ? consistency_bound<float>(rtol) : consistency_bound<double>(rtol);
  const auto norm = [](const at::Tensor& t) { return t.flatten(1).norm(2, 1); };
  const auto whole = norm(b);
  return {norm(b - projected) > at::maximum(bound * whole, rounding), norm(projected) <= epsilon_of(b) * whole};
}

}  // namespace

at::Tensor largest_magnitude(const at::Tensor& b) {
  const auto plain = b.detach();
  const bool has_memory = !at::isTensorSubclassLike(plain);
  return has_memory && batch_loops::take(plain) ? batch_loops::largest_magnitude(plain)
                                                : plain.abs().flatten(1).amax(1);
}

at::Tensor subnormal_rounding(const at::Tensor& scale, const at::Tensor& b) {
  return scale.flatten() * limits_of(b).least *
         std::sqrt(static_cast<double>(b.numel() / std::max<int64_t>(b.size(0), 1)));
}

PreparedBatch prepare_batch(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  const auto& solver = request.solver;
  const bool starts = takes_start(solver.method, request.x0);
  const auto magnitude = largest_magnitude(b);
  auto status = settle_beforehand(a, solver, b, magnitude, starts ? largest_magnitude(request.x0) : at::Tensor());
  auto takes_part = status.eq(static_cast<int64_t>(SolveStatus::kMaxIter));
  const auto [whole, scale] = scale_samples(b, magnitude, takes_part);
  const auto rhs = a.project(whole);
  const auto rounding = subnormal_rounding(scale, b);
  auto inconsistent = at::zeros_like(takes_part);
  if (a.needs_projection()) {
    const auto outside = outside_range(whole, rhs, solver.rtol, rounding);
    const auto hopeless = outside.all.logical_and(takes_part);
    inconsistent = outside.some.logical_and(takes_part);
    const auto mark = [&](const at::Tensor& rows, SolveStatus why) {
      status = status.masked_fill(rows, static_cast<int64_t>(why));
    };
    mark(hopeless, SolveStatus::kStagnated);  // all of b is its rounding
    mark(hopeless.logical_and(inconsistent), SolveStatus::kInconsistent);
    takes_part = takes_part.logical_and(hopeless.logical_not());
  }
  TensorStart start;
  if (starts) start = make_start(a, rhs, at::where(per_sample(takes_part, b), request.x0, at::zeros_like(rhs)));
  return {status, takes_part, inconsistent, rhs, scale, rounding, start};
}

}  // namespace prdp
