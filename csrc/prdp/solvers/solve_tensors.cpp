#include <ATen/core/grad_mode.h>

#include <cstdlib>

#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/inverse.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/prepared_batch.h"
#include "prdp/solvers/tensor_gmres.h"
#include "prdp/solvers/tensor_space.h"

namespace prdp {

namespace {

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
    info.floor.mutable_data_ptr<double>()[i] =
        s.floor2 > 0.0 && !is_failure(s.status) ? std::sqrt(s.floor2 / s.b2) : 0.0;
  }
  for (auto* part : {&info.residual, &info.floor}) *part = part->to(real.device(at::kCPU));
  return info;
}

/// The states as they are before the first iteration. One copy.
void tell(std::vector<SampleState>& states, const PreparedBatch& batch, const at::Tensor& b2) {
  const auto& applied = batch.start.applied;
  const auto number = [&](const at::Tensor& t) { return t.flatten().to(b2.scalar_type()); };
  const auto host = at::stack({number(batch.status), number(b2),
                               applied.defined() ? number(applied) : at::zeros_like(number(b2)), batch.rounding})
                        .to(at::kCPU, at::kDouble);
  const auto rows = host.accessor<double, 2>();
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    s.status = static_cast<SolveStatus>(static_cast<int64_t>(rows[0][i]));
    s.b2 = rows[1][i];
    s.rounding2 = rows[3][i] * rows[3][i];
    if (s.status == SolveStatus::kMaxIter) {
      s.applications += static_cast<int64_t>(rows[2][i]);
      continue;
    }
    s.active = false;
    s.settled = true;
    s.iterations = s.applications = 0;
    if (s.status == SolveStatus::kInconsistent || s.status == SolveStatus::kStagnated) s.residual2 = s.b2 = 1.0;
    if (s.status == SolveStatus::kStagnated) s.floor2 = 1.0;
  }
}

/// b with its rows scaled.
struct ScaledRhs {
  at::Tensor b, scale;
};
ScaledRhs scale_whole(const at::Tensor& b) {
  const auto scale = per_sample(power_of_two_scale(largest_magnitude(b)), b);
  return {b * scale, scale};
}

/// The same recorded, of b and the tensors of A, for a start that is a constant.
at::Tensor rest_of(const Operator& a, const at::Tensor& b, const at::Tensor& start) {
  return start.defined() ? b - a.project(a.apply(start)) : b;
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

/// glibc returns the top of the heap to the system once it exceeds twice the largest block ever freed. Vectors of some
/// 100 KB are then faulted in again for every product, which can double the time of a solve. A large block that is
/// freed untouched raises the bound, as the first large tensor of a training would.
void keep_top_of_heap() {
  [[maybe_unused]] static const bool done = [] {
    void* volatile block = std::malloc((size_t{32} << 20) - 8192);  // volatile: or the pair is optimised away
    std::free(block);
    return true;
  }();
}

}  // namespace

SolveResult solve_with_tensors(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  const at::NoGradGuard no_grad;
  if (b.is_cpu()) keep_top_of_heap();
  const auto& solver = request.solver;
  const auto batch = prepare_batch(a, b, request);
  std::vector<SampleState> states(b.size(0));
  const auto caps = request.caps ? request.caps->to(at::kCPU).contiguous() : at::Tensor();
  for (size_t i = 0; i < states.size(); ++i)
    states[i].cap = caps.defined() ? caps.const_data_ptr<int64_t>()[i] : solver.max_iter.expect_int();
  const auto inverse = make_inverse(a, solver.preconditioner, b);
  TensorSpace::System system{a, solver.preconditioner, inverse};
  TensorSpace space(system, batch.rhs, states);
  tell(states, batch, space.b2());
  if (batch.start.x.defined()) space.start_from(batch.start.x, batch.start.r);

  const auto run = [&](auto method) {
    iterate(space, method, states, solver.rtol, request.guarded);
    return a.project_solution(space.solution(method.x));
  };
  const bool in_batches = solver.method == Method::kGmres && space.is_far();
  auto u =
      in_batches ? run(TensorGmres(space, solver.restart)) : with_method(solver.method, solver.restart, space, run);
  const auto before = largest_magnitude(u) * batch.takes_part;
  u = at::where(per_sample(batch.takes_part, b), u / batch.scale, at::zeros_like(b));
  const auto largest = largest_magnitude(u);
  const auto host = at::stack({batch.inconsistent.to(u.scalar_type()), before, largest}).to(at::kCPU, at::kDouble);
  const auto rows = host.accessor<double, 2>();
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    if (request.guarded) excuse_rounding_of_b(s);
    if (rows[0][i] != 0.0 && !is_failure(s.status)) s.status = SolveStatus::kInconsistent;
    if (is_refused(s.status) || !(rows[1][i] > 0.0)) continue;
    if (u.scalar_type() == at::kFloat) note_underflow<float>(s, rows[2][i]);
    else note_underflow<double>(s, rows[2][i]);
  }
  if (!request.guarded) return {u.contiguous(), info_of(states, b.options())};
  bool overflows = false;
  for (size_t i = 0; i < states.size(); ++i) {
    if (std::isfinite(rows[2][i])) continue;
    overflows = true;
    states[i].status = SolveStatus::kOverflow;
    states[i].iterations = 0;
    states[i].residual2 = states[i].b2;
    states[i].floor2 = 0.0;
  }
  if (overflows) u = at::where(per_sample(largest.isfinite(), b), u, at::zeros_like(u));
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
  const auto b2 = dot_in_order(rhs_, rhs_).reshape({-1}).to(at::kCPU, at::kDouble);
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
