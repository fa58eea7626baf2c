#include "prdp/solvers/solve_recorded.h"

#include <algorithm>

#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/prepared_batch.h"
#include "prdp/solvers/tensor_preconditioner.h"
#include "prdp/solvers/tensor_space.h"

namespace prdp {

namespace {

/// b - A start, differentiable in b and the tensors of A; the start is a constant.
at::Tensor residual_of_start(const Operator& a, const at::Tensor& b, const at::Tensor& start) {
  return start.defined() ? b - a.project(a.apply(start)) : b;
}

/// One more iteration of the samples whose cap is beyond the `done` that they have taken.
template <class M>
void iterate_once_more(TensorSpace& space, M& method, std::vector<SampleState>& states, double rtol, int64_t done) {
  const auto wanted = [&](const SampleState& s) { return done < s.cap; };
  space.freeze_unless(states, wanted);
  detail::repeat_iteration(method, rtol, done, [&] {
    const auto residual2 = space.values_of(method.residual2());
    for (size_t i = 0; i < states.size(); ++i)
      states[i].candidate = wanted(states[i]) && is_within(residual2[i], rtol, states[i].b2);
    const auto candidate = [](const SampleState& s) { return s.candidate; };
    if (std::none_of(states.begin(), states.end(), candidate)) return;
    space.freeze_unless(states, candidate);
    method.recompute_residual();
    space.freeze_unless(states, wanted);
  });
}

}  // namespace

RecordedSolve solve_recorded(const Operator& a, const at::Tensor& b, const at::Tensor& x0, const Solver& solver,
                             const at::Tensor& caps) {
  // Samples of no iterations return zero and have no derivative. They are left out: an operator that
  // was refused would send NaN backwards even from behind a mask.
  const auto index = caps.gt(0).nonzero().flatten().to(b.device());
  if (index.numel() < b.size(0)) {
    const auto zeros = at::zeros_like(b), none = at::zeros_like(caps);
    if (index.numel() == 0) return {zeros, none};
    // A preconditioner of the user's own cannot be had without them.
    if (const auto part = solver.preconditioner.is_operator() ? nullptr : a.select(index)) {
      const auto there = index.to(caps.device());
      const auto x0_there = x0.defined() ? x0.index_select(0, index) : x0;
      const auto some = solve_recorded(*part, b.index_select(0, index), x0_there, solver, caps.index_select(0, there));
      return {zeros.index_copy(0, index, some.u), none.index_copy(0, there, some.operator_applications)};
    }
  }
  const auto host_caps = to_host<int64_t>(caps, caps.numel());
  const int64_t most = *std::max_element(host_caps.begin(), host_caps.end());
  std::vector<SampleState> states(b.size(0));
  const auto [rhs, scale] = scale_samples(b, largest_magnitude(b));
  const auto whole = a.project(rhs);
  const auto inverse = make_inverse(a, solver.preconditioner, b);
  TensorSpace::System system{a, solver.preconditioner, inverse};
  TensorSpace space(system, whole, states, /*recording=*/true);
  const auto b2 = space.values_of(space.b2());
  for (size_t i = 0; i < states.size(); ++i) {
    states[i].cap = host_caps[i];
    states[i].b2 = b2[i];
  }
  if (takes_start(solver.method, x0)) {
    const auto start = make_start(a, whole.detach(), x0).x;
    space.start_from(start, residual_of_start(a, whole, start));
  }
  const auto u = with_method(solver.method, solver.restart, space, [&](auto m) {
    m.start();
    for (int64_t done = 0; done < most; ++done) iterate_once_more(space, m, states, solver.rtol, done);
    return a.project_solution(space.solution(m.x)) / scale;
  });
  std::vector<int64_t> applications;
  for (const auto& s : states) applications.push_back(s.applications);
  return {u, at::tensor(applications, at::kLong).to(caps.device())};
}

StepwiseSolve::StepwiseSolve(const Operator& a, const Solver& solver, const at::Tensor& b, const at::Tensor& x0,
                             const at::Tensor& caps)
    : solver_(solver), inverse_(make_inverse(a, solver.preconditioner, b)) {
  const auto [scaled, scale] = scale_samples(b, largest_magnitude(b));
  scale_ = scale;
  rhs_ = a.project(scaled);
  b2_ = to_host<double>(dot_in_order(rhs_, rhs_), rhs_.size(0));
  if (takes_start(solver.method, x0)) {
    const auto made = make_start(a, rhs_, x0);
    start_ = made.x / scale_;
    rhs_ = made.r;
  }
  caps_ = to_host<int64_t>(caps, caps.numel());
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
    auto state = std::tuple_cat(std::tie(method.x), method.iteration_state());
    if (!before.empty()) {
      size_t next = 0;
      std::apply([&](auto&... part) { ((part = before[next++]), ...); }, state);
      method.resume(done);
    }
    iterate_once_more(space, method, states, solver_.rtol, done);
    std::apply([&](const auto&... part) { (after.push_back(part), ...); }, state);
    return 0;
  });
  for (size_t i = 0; i < states.size(); ++i) applications_[i] += states[i].applications;
  scale_of_a_ = system.scale_of_a;
  scale_of_inverse_ = system.scale_of_inverse;
  return after;
}

}  // namespace prdp
