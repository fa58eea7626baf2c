#include <ATen/core/grad_mode.h>

#include "prdp/operators/tensors.h"
#include "prdp/solvers/inverse.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/solve.h"
#include "prdp/solvers/tensor_gmres.h"
#include "prdp/solvers/tensor_space.h"

namespace prdp {

namespace {

/// What is known of the samples before they are iterated, (batch,) each, on their device: the status, which is MAX_ITER
/// of those that are not settled yet; ‖b‖²; whether b lies outside the range of A, beyond rtol; whether the start took
/// a product.
struct Beforehand {
  at::Tensor status, b2, inconsistent, applied;

  /// One copy.
  void tell(std::vector<SampleState>& states) const {
    const auto host =
        at::stack({status.to(b2.scalar_type()), b2, applied.to(b2.scalar_type())}).to(at::kCPU, at::kDouble);
    const auto rows = host.accessor<double, 2>();
    for (size_t i = 0; i < states.size(); ++i) {
      auto& s = states[i];
      s.status = static_cast<SolveStatus>(static_cast<int64_t>(rows[0][i]));
      s.b2 = rows[1][i];
      if (s.status == SolveStatus::kMaxIter) {
        s.applications += static_cast<int64_t>(rows[2][i]);
        continue;
      }
      s.active = false;
      s.settled = true;
      s.iterations = s.applications = 0;
      if (s.status == SolveStatus::kInconsistent) s.residual2 = s.b2 = 1.0;
    }
  }
};

/// The status of each sample that is settled before iterating, and MAX_ITER of the others.
at::Tensor settle_beforehand(const Operator& a, const Solver& solver, const at::Tensor& b, const at::Tensor& magnitude,
                             const at::Tensor& start_magnitude) {
  const int64_t batch = magnitude.size(0);
  auto status = at::full({batch}, static_cast<int64_t>(SolveStatus::kMaxIter), magnitude.options().dtype(at::kLong));
  const auto mark = [&](const at::Tensor& rows, SolveStatus why) {
    status = status.masked_fill(rows.reshape({-1}).expand({batch}).to(status.device()), static_cast<int64_t>(why));
  };
  // The last mark holds: the order is that of the CPU loops, from the end.
  mark(magnitude.eq(0), SolveStatus::kConverged);
  if (divides_by_diagonal(solver)) {
    const auto zero = a.diagonal().eq(0);
    mark(zero.dim() > 1 ? zero.flatten(1).any(1) : zero.any(), SolveStatus::kZeroDiagonal);
  }
  mark(a.nonfinite_samples(b), SolveStatus::kNonfiniteOperator);
  if (start_magnitude.defined()) mark(start_magnitude.isfinite().logical_not(), SolveStatus::kNonfiniteInput);
  mark(magnitude.isfinite().logical_not(), SolveStatus::kNonfiniteInput);
  return status;
}

SolveInfo info_of(const std::vector<SampleState>& states, const at::TensorOptions& real) {
  const auto batch = static_cast<int64_t>(states.size());
  const auto counts = at::TensorOptions().dtype(at::kLong);
  SolveInfo info{at::empty({batch}, counts), at::empty({batch}, at::kDouble), at::empty({batch}, counts),
                 at::empty({batch}, counts), at::empty({batch}, at::kDouble)};
  for (int64_t i = 0; i < batch; ++i) {
    const auto& s = states[i];
    double residual = s.b2 > 0.0 ? std::sqrt(s.residual2 / s.b2) : 0.0;
    if (s.status == SolveStatus::kZeroDiagonal) residual = 1.0;
    else if (is_refused(s.status) || std::isnan(residual)) residual = std::numeric_limits<double>::infinity();
    info.iterations.mutable_data_ptr<int64_t>()[i] = s.iterations;
    info.residual.mutable_data_ptr<double>()[i] = residual;
    info.status.mutable_data_ptr<int64_t>()[i] = static_cast<int64_t>(s.status);
    info.operator_applications.mutable_data_ptr<int64_t>()[i] = s.applications;
    info.floor.mutable_data_ptr<double>()[i] = s.floor2 > 0.0 ? std::sqrt(s.floor2 / s.b2) : 0.0;
  }
  for (auto* part : {&info.residual, &info.floor}) *part = part->to(real.device(at::kCPU));
  return info;
}

/// b with its rows scaled, and `others` in place of the rows that do not take part.
struct ScaledRhs {
  at::Tensor b, scale;
};
ScaledRhs scale_rhs(const at::Tensor& b, const at::Tensor& magnitude, const at::Tensor& takes_part,
                    const at::Tensor& others) {
  const auto safe = at::where(takes_part, magnitude, at::ones_like(magnitude));
  const auto scale = per_sample(power_of_two_scale(safe), b);
  const auto rows = per_sample(takes_part, b);
  return {at::where(rows, b, others) * scale, scale};
}

at::Tensor largest_magnitude(const at::Tensor& b) { return b.detach().abs().flatten(1).amax(1); }

ScaledRhs scale_whole(const at::Tensor& b) {
  const auto scale = per_sample(power_of_two_scale(largest_magnitude(b)), b);
  return {b * scale, scale};
}

/// Where the iterations of a batch start, and whether that took a product.
struct TensorStart {
  at::Tensor x, r;     // r = b - A x
  at::Tensor applied;  // (batch, 1, …)
};

/// As SampleSpace::start_from; b is scaled and within the range of A. A constant: but autograd stays on, as an
/// operator keeps what it computes first, for later products as well.
TensorStart make_start(const Operator& a, const at::Tensor& b, const at::Tensor& x0) {
  const auto of_order_one = [](const at::Tensor& v) {
    const auto magnitude = largest_magnitude(v);
    const auto usable = magnitude.isfinite().logical_and(magnitude.gt(0));
    return scale_rhs(v, magnitude, usable, at::zeros_like(v));
  };
  const auto dot = [&](const at::Tensor& v, const at::Tensor& w) { return per_sample((v * w).flatten(1).sum(1), b); };
  const auto y = of_order_one(x0.detach()).b;
  const auto [product, scale] = of_order_one(a.project(a.apply(a.project_solution(y))));
  const auto product2 = dot(product, product);
  const auto alpha = dot(b, product) / at::where(product2.gt(0), product2, at::ones_like(product2));
  const auto x = a.project_solution(y) * scale * alpha, r = b - alpha * product;
  const auto better = dot(r, r).lt(dot(b, b)).logical_and(per_sample(x.isfinite().flatten(1).all(1), b));
  return {at::where(better, x, at::zeros_like(x)).detach(), at::where(better, r, b).detach(),
          per_sample(y.flatten(1).ne(0).any(1), b)};
}

/// The same recorded, of b and the tensors of A, for a start that is a constant.
at::Tensor rest_of(const Operator& a, const at::Tensor& b, const at::Tensor& start) {
  return start.defined() ? b - a.project(a.apply(start)) : b;
}

bool takes_start(Method method, const at::Tensor& x0) { return x0.defined() && !traits(method).is_direct; }

/// Of which samples' right-hand sides so much lies outside the range of a singular operator: more than rtol; all.
struct OutsideRange {
  at::Tensor some, all;
};
OutsideRange outside_range(const at::Tensor& b, const at::Tensor& projected, double rtol) {
  const double bound = b.scalar_type() == at::kFloat ? consistency_bound<float>(rtol) : consistency_bound<double>(rtol);
  const auto norm = [](const at::Tensor& t) { return t.flatten(1).norm(2, 1); };
  const auto whole = norm(b);
  return {norm(b - projected) > bound * whole, norm(projected) <= epsilon_of(b) * whole};
}

/// Where a method's own residual claims convergence, in vain as the samples are `wanted` further.
template <class M, class Predicate>
void go_on_from_true_residuals(TensorSpace& space, M& method, std::vector<SampleState>& states, double rtol,
                               const Predicate& wanted) {
  const auto residual2 = space.lanes(method.residual2());
  for (size_t i = 0; i < states.size(); ++i)
    states[i].claims = wanted(states[i]) && detail::is_within(residual2[i], rtol, states[i].b2);
  const auto claims = [](const SampleState& s) { return s.claims; };
  if (std::none_of(states.begin(), states.end(), claims)) return;
  space.freeze_unless(states, claims);
  method.recompute_residual();
}

/// One more iteration of the samples whose cap is beyond the `done` that they have taken, as iterate() takes
/// it: a method whose own residual claimed convergence before, in vain, goes on from the true one.
template <class M>
void iterate_again(TensorSpace& space, M& method, std::vector<SampleState>& states, double rtol, int64_t done) {
  const auto wanted = [&](const SampleState& s) { return done < s.cap; };
  if constexpr (detail::kHasRecursiveResidual<M>) {
    if (rtol > 0.0 && done > 0) go_on_from_true_residuals(space, method, states, rtol, wanted);
  }
  space.freeze_unless(states, wanted);
  if constexpr (detail::kTakesStrides<M>) method.step(1);
  else method.step();
  if constexpr (detail::kLeastResidual<M>) method.residual2();
}

}  // namespace

SolveResult solve_with_tensors(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  const at::NoGradGuard no_grad;
  const auto magnitude = largest_magnitude(b);
  const auto& solver = request.solver;
  const bool starts = takes_start(solver.method, request.x0);
  auto status = settle_beforehand(a, solver, b, magnitude, starts ? largest_magnitude(request.x0) : at::Tensor());
  auto takes_part = status.eq(static_cast<int64_t>(SolveStatus::kMaxIter));
  std::vector<SampleState> states(b.size(0));
  const auto caps = request.caps ? request.caps->to(at::kCPU).contiguous() : at::Tensor();
  for (size_t i = 0; i < states.size(); ++i)
    states[i].cap = caps.defined() ? caps.const_data_ptr<int64_t>()[i] : solver.max_iter.expect_int();
  // A device that nobody has to look at iterates all samples, with something to do for those that need no iterations.
  const bool looks_late = solver.rtol == 0.0 && !b.is_cpu();
  const auto [whole, scale] = scale_rhs(b, magnitude, takes_part, looks_late ? alternating(b) : at::zeros_like(b));
  const auto rhs = a.project(whole);
  const auto outside = outside_range(whole, rhs, solver.rtol);
  const auto inconsistent = outside.some.logical_and(takes_part), hopeless = outside.all.logical_and(takes_part);
  status = status.masked_fill(hopeless, static_cast<int64_t>(SolveStatus::kInconsistent));
  takes_part = takes_part.logical_and(hopeless.logical_not());
  const auto inverse = make_inverse(a, solver.preconditioner, b);
  TensorSpace::System system{a, solver.preconditioner, inverse};
  TensorSpace space(system, rhs, states);
  Beforehand beforehand{status, space.b2().flatten(), inconsistent, at::zeros_like(takes_part)};
  if (starts) {
    const auto made = make_start(a, rhs, at::where(per_sample(takes_part, b), request.x0, at::zeros_like(rhs)));
    beforehand.applied = made.applied.flatten();
    space.start_from(made.x, made.r);
  }
  if (looks_late) space.settle_by([&](auto& samples) { beforehand.tell(samples); });
  else beforehand.tell(states);

  const auto run = [&](auto method) {
    iterate(space, method, states, solver.rtol, request.guarded);
    return a.project_solution(space.solution(method.x));
  };
  const bool in_batches = solver.method == Method::kGmres && space.is_far();
  auto u =
      in_batches ? run(TensorGmres(space, solver.restart)) : with_method(solver.method, solver.restart, space, run);
  const auto before = largest_magnitude(u) * takes_part;
  u = at::where(per_sample(takes_part, b), u / scale, at::zeros_like(b));
  const auto largest = largest_magnitude(u);
  const auto host = at::stack({beforehand.inconsistent.to(u.scalar_type()), before, largest}).to(at::kCPU, at::kDouble);
  const auto rows = host.accessor<double, 2>();
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (rows[0][i] != 0.0 && !is_failure(s.status)) s.status = SolveStatus::kInconsistent;
    if (is_refused(s.status) || !(rows[1][i] > 0.0)) continue;
    if (u.scalar_type() == at::kFloat) note_underflow<float>(s, rows[2][i]);
    else note_underflow<double>(s, rows[2][i]);
  }
  if (!request.guarded) return {u.contiguous(), info_of(states, b.options())};
  u = at::where(per_sample(largest.isfinite(), b), u, at::zeros_like(u));
  for (size_t i = 0; i < states.size(); ++i) {
    if (std::isfinite(rows[2][i])) continue;
    states[i].status = SolveStatus::kOverflow;
    states[i].iterations = 0;
    states[i].residual2 = states[i].b2;
    states[i].floor2 = 0.0;
  }
  return {u.contiguous(), info_of(states, b.options())};
}

RecordedSolve solve_recorded(const Operator& a, const at::Tensor& b, const at::Tensor& x0, const Solver& solver,
                             const at::Tensor& caps) {
  // Samples of no iterations return zero and have no derivative. They are left out: an operator that
  // was refused would send NaN backwards even from behind a mask.
  const auto index = caps.gt(0).nonzero().flatten().to(b.device());
  if (index.numel() < b.size(0)) {
    const auto zeros = at::zeros_like(b), none = at::zeros_like(caps);
    if (index.numel() == 0) return {zeros, none};
    if (const auto part = a.select(index)) {
      const auto there = index.to(caps.device());
      const auto x0_there = x0.defined() ? x0.index_select(0, index) : x0;
      const auto some = solve_recorded(*part, b.index_select(0, index), x0_there, solver, caps.index_select(0, there));
      return {zeros.index_copy(0, index, some.u), none.index_copy(0, there, some.operator_applications)};
    }
  }
  const auto host_caps = caps.to(at::kCPU).contiguous();
  const int64_t most =
      *std::max_element(host_caps.const_data_ptr<int64_t>(), host_caps.const_data_ptr<int64_t>() + host_caps.numel());
  std::vector<SampleState> states(b.size(0));
  const auto [rhs, scale] = scale_whole(b);
  const auto whole = a.project(rhs);
  const auto inverse = make_inverse(a, solver.preconditioner, b);
  TensorSpace::System system{a, solver.preconditioner, inverse};
  TensorSpace space(system, whole, states, /*recording=*/true);
  const auto b2 = space.lanes(space.b2());
  for (size_t i = 0; i < states.size(); ++i) {
    states[i].cap = host_caps.const_data_ptr<int64_t>()[i];
    states[i].b2 = b2[i];
  }
  if (takes_start(solver.method, x0)) {
    const auto start = make_start(a, whole.detach(), x0).x;
    space.start_from(start, rest_of(a, whole, start));
  }
  const auto u = with_method(solver.method, solver.restart, space, [&](auto m) {
    m.start();
    for (int64_t done = 0; done < most; ++done) iterate_again(space, m, states, solver.rtol, done);
    return a.project_solution(space.solution(m.x)) / scale;
  });
  return {u, info_of(states, b.options()).operator_applications.to(caps.device())};
}

StepwiseSolve::StepwiseSolve(const Operator& a, const Solver& solver, const at::Tensor& b, const at::Tensor& x0,
                             const at::Tensor& caps)
    : solver_(solver), inverse_(make_inverse(a, solver.preconditioner, b)) {
  const auto [scaled, scale] = scale_whole(b);
  scale_ = scale;
  rhs_ = a.project(scaled);
  const auto b2 = rhs_.square().flatten(1).sum(1).to(at::kCPU, at::kDouble);
  b2_.assign(b2.const_data_ptr<double>(), b2.const_data_ptr<double>() + b2.numel());
  if (takes_start(solver.method, x0)) {
    const auto made = make_start(a, rhs_, x0);
    start_ = made.x / scale_;
    rhs_ = made.r;
  }
  const auto host = caps.to(at::kCPU).contiguous();
  caps_.assign(host.const_data_ptr<int64_t>(), host.const_data_ptr<int64_t>() + host.numel());
  applications_.resize(caps_.size());
}

int64_t StepwiseSolve::iterations() const { return *std::max_element(caps_.begin(), caps_.end()); }

StepwiseSolve::State StepwiseSolve::step(const Operator& a, const at::Tensor& rhs, const State& before, int64_t done) {
  std::vector<SampleState> states(caps_.size());
  TensorSpace::System system{a, solver_.preconditioner, inverse_, scale_of_a_, scale_of_inverse_};
  TensorSpace space(system, rhs, states, /*recording=*/true);
  for (size_t i = 0; i < states.size(); ++i) {
    states[i].cap = caps_[i];
    states[i].b2 = b2_[i];
  }
  State after;
  with_method(solver_.method, solver_.restart, space, [&](auto method) {
    method.start();
    auto state = std::tuple_cat(std::tie(method.x), method.carried());
    if (!before.empty()) {
      size_t next = 0;
      std::apply([&](auto&... part) { ((part = before[next++]), ...); }, state);
      method.resume(done);
    }
    iterate_again(space, method, states, solver_.rtol, done);
    std::apply([&](const auto&... part) { (after.push_back(part), ...); }, state);
    return 0;
  });
  for (size_t i = 0; i < states.size(); ++i) applications_[i] += states[i].applications;
  scale_of_a_ = system.scale_of_a;
  scale_of_inverse_ = system.scale_of_inverse;
  return after;
}

}  // namespace prdp
