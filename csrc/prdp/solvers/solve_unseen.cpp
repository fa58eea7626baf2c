#include "prdp/solvers/solve_unseen.h"

#include <algorithm>
#include <limits>

#include "prdp/operators/tensors.h"
#include "prdp/solvers/inverse.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/prepared_batch.h"
#include "prdp/solvers/tensor_space.h"

namespace prdp {

namespace {

/// The numbers of this many iterations are kept on the device; longer solves are watched.
constexpr int64_t kMostUnseen = 4096;

bool goes_unseen(const at::Tensor& b, const Solver& solver) {
  const auto& method = traits(solver.method);
  return !b.is_cpu() && solver.rtol == 0.0 && !method.is_direct && method.counts == Counts::kIterations &&
         solver.max_iter.maybe_as_int().value_or(kMostUnseen + 1) <= kMostUnseen;
}

constexpr int64_t code(SolveStatus status) { return static_cast<int64_t>(status); }

/// One double per sample.
at::Tensor numbers_of(const at::Tensor& t) { return t.flatten().to(at::kDouble); }

/// What the iterations of a batch left, on the device, one value per sample.
struct UnseenEnd {
  at::Tensor u;          // scaled
  at::Tensor residual2;  // ‖b - A u‖² and ‖b‖², in double
  at::Tensor b2;
  at::Tensor broken;     // undefined: nowhere
  at::Tensor falls;      // energy_falls(), of methods that descend it
  int64_t iterations, products;
};

/// The report and u as iterate() and solve_with_tensors() give them, and which samples are zero in place of an iterate.
struct UnseenReport {
  SolveResult result;
  at::Tensor gone;
};

UnseenReport report_unseen(const PreparedBatch& batch, const UnseenEnd& end, const at::Tensor& b) {
  const auto& open = batch.takes_part;
  auto status = batch.status;
  auto residual2 = end.residual2;
  const auto is = [&](SolveStatus s) { return status.eq(code(s)); };
  const auto set = [&](const at::Tensor& rows, SolveStatus why) {
    status = status.masked_fill(rows.logical_and(open), code(why));
  };
  if (end.broken.defined()) set(end.broken, SolveStatus::kBreakdown);
  set(residual2 <= 0.0, SolveStatus::kConverged);
  const auto above = residual2 > (1.0 + 128.0 * epsilon_of(b)) * end.b2;
  if (end.falls.defined()) set(is(SolveStatus::kMaxIter).logical_and(above & ~end.falls), SolveStatus::kDiverged);
  set(residual2 > kDivergenceBound * kDivergenceBound * end.b2, SolveStatus::kDiverged);
  set(residual2.isfinite().logical_not(), SolveStatus::kOverflow);
  const auto applications = batch.start.applied.defined() ? batch.start.applied.flatten() + end.products
                                                          : at::full_like(status, end.products);
  const auto for_energy = end.falls.defined() ? above.to(at::kLong) : at::zeros_like(status);

  auto gone = above.logical_or(residual2.isfinite().logical_not()).logical_and(open);
  if (end.falls.defined()) gone = gone.logical_and(is(SolveStatus::kMaxIter).logical_not());
  // As excuse_rounding_of_b(), of the residual of what is handed out.
  const auto left2 = at::where(gone, end.b2, residual2);
  const auto excused = (is(SolveStatus::kDiverged) | is(SolveStatus::kBreakdown))
                           .logical_and(open)
                           .logical_and(left2 <= batch.rounding.to(at::kDouble).square());
  set(excused, SolveStatus::kStagnated);
  const auto before = largest_magnitude(end.u) * open;
  auto u = at::where(per_sample(open.logical_and(gone.logical_not()), b), end.u / batch.scale, at::zeros_like(b));
  const auto largest = largest_magnitude(u);
  set(batch.inconsistent.logical_and(status >= code(SolveStatus::kStagnated)), SolveStatus::kInconsistent);

  // As note_underflow().
  const bool single = b.scalar_type() == at::kFloat;
  const double normal = single ? std::numeric_limits<float>::min() : std::numeric_limits<double>::min();
  const double least = single ? std::numeric_limits<float>::denorm_min() : std::numeric_limits<double>::denorm_min();
  const auto lost2 = at::where(largest.eq(0), 1.0, least / largest.to(at::kDouble)).square() * end.b2;
  const auto underflows =
      before.gt(0).logical_and(largest < normal).logical_and(residual2 < lost2).logical_and(gone.logical_not());
  residual2 = at::where(underflows, lost2, residual2);
  set(underflows.logical_and(status > 0), SolveStatus::kStagnated);

  const auto too_large = largest.isfinite().logical_not();
  set(too_large, SolveStatus::kOverflow);
  gone = gone.logical_or(too_large.logical_and(open));
  u = at::where(per_sample(too_large, b), at::zeros_like(u), u);

  const auto relative = [&](const at::Tensor& square) { return at::sqrt(square / end.b2); };
  const auto of_settled =
      at::where(is(SolveStatus::kConverged), 0.0,
                at::where(status <= code(SolveStatus::kNonfiniteInput), std::numeric_limits<double>::infinity(), 1.0));
  const auto residual = at::where(open, at::where(gone, 1.0, relative(residual2)), of_settled);
  const auto all_is_rounding = batch.status.eq(code(SolveStatus::kStagnated)).logical_or(excused);
  const auto floor = floor_of(
      at::where(underflows.logical_and(open), relative(lost2), at::where(all_is_rounding, residual, 0.0)), status);
  const auto counted = open.logical_and(gone.logical_not());
  return {{u.contiguous(), {counted * end.iterations, residual, status, (applications + for_energy) * open, floor}},
          gone};
}

/// The report on the host, by one copy; nothing if a sample is to be watched.
std::optional<SolveInfo> look(const UnseenReport& report, const UnseenNumbers& log, const PreparedBatch& batch) {
  auto info = report.result.info;
  const int64_t size = batch.status.size(0);
  std::vector<at::Tensor> rows;
  for (const auto* part : info.parts()) rows.push_back(part->to(at::kDouble));
  rows.push_back(report.gone.to(at::kDouble));
  rows.push_back(batch.takes_part.to(at::kDouble));
  const auto told = at::stack(rows).flatten();
  const auto numbers = log.numbers();
  const auto host = (numbers.defined() ? at::cat({told, numbers.to(at::kDouble)}) : told).to(at::kCPU);
  const auto parts = host.slice(0, 0, told.size(0)).view({-1, size});
  const auto seen = log.read(host.const_data_ptr<double>() + told.size(0), size);
  for (int64_t i = 0; i < size; ++i) {
    if (parts[5].const_data_ptr<double>()[i] != 0.0) return std::nullopt;
    if (parts[6].const_data_ptr<double>()[i] == 0.0) continue;
    if (std::any_of(seen.odd.begin(), seen.odd.end(), [i](const auto& odd) { return odd[i]; })) return std::nullopt;
  }
  int64_t next = 0;
  for (auto* part : info.parts()) *part = parts[next++].to(part->scalar_type());
  return info;
}

}  // namespace

bool never_waits(const at::Tensor& b, const Solver& solver) {
  return goes_unseen(b, solver) && !traits(solver.method).starts_anew;
}

std::optional<SolveResult> solve_unseen(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  if (!goes_unseen(b, request.solver) || request.caps || !request.guarded) return std::nullopt;
  const auto& solver = request.solver;
  const auto batch = prepare_batch(a, b, request, /*others=*/alternating(b));
  std::vector<SampleState> states(b.size(0));
  const auto inverse = make_inverse(a, solver.preconditioner, b);
  TensorSpace::System system{a, solver.preconditioner, inverse};
  TensorSpace space(system, batch.rhs, states);
  const auto b2 = numbers_of(space.b2());
  if (batch.start.x.defined()) space.start_from(batch.start.x, batch.start.r);

  return with_method(solver.method, solver.restart, space, [&](auto method) -> std::optional<SolveResult> {
    using M = decltype(method);
    if constexpr (detail::kMayGoUnseen<TensorSpace, M>) {
      const int64_t iterations = solver.max_iter.expect_int();
      method.start();
      detail::iterate_unseen(space, method, /*rtol=*/0.0, /*track=*/false, iterations);
      const auto log = space.take_log();
      UnseenEnd end{{}, numbers_of(method.recompute_residual()), b2, {}, {}, iterations, log.products() + 1};
      const bool waits = request.may_wait || !never_waits(b, solver);
      if (!waits) end.broken = log.broken();
      if constexpr (detail::kDescendsEnergy<M>)
        end.falls = detail::energy_falls(detail::energies(space, method, numbers_of), space.epsilon());
      end.u = a.project_solution(space.solution(method.x));
      auto report = report_unseen(batch, end, b);
      auto& [u, info] = report.result;
      if (waits) {
        const auto seen = look(report, log, batch);
        if (!seen) return std::nullopt;
        info = *seen;
      }
      for (auto* part : {&info.residual, &info.floor}) *part = part->to(b.scalar_type());
      return report.result;
    }
    return std::nullopt;
  });
}

}  // namespace prdp
