#include <ATen/Context.h>
#include <ATen/core/grad_mode.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <functional>
#include <limits>

#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/prepared_batch.h"
#include "prdp/solvers/tensor_gmres.h"
#include "prdp/solvers/tensor_preconditioner.h"
#include "prdp/solvers/tensor_space.h"

namespace prdp {

namespace {

/// The states before the first iteration: those of samples that are settled are not active. One copy.
void fill_states(std::vector<SampleState>& states, const PreparedBatch& batch, const at::Tensor& b2,
                 const SolveRequest& request) {
  const auto& applied = batch.start.applied;
  const auto number = [&](const at::Tensor& t) { return t.flatten().to(b2.scalar_type()); };
  const auto host = at::stack({number(batch.status), number(b2),
                               applied.defined() ? number(applied) : at::zeros_like(number(b2)), batch.rounding})
                        .to(at::kCPU, at::kDouble);
  const auto rows = host.accessor<double, 2>();
  const auto status = rows[0], norm2 = rows[1], products = rows[2], rounding = rows[3];
  for (size_t i = 0; i < states.size(); ++i) {
    auto& s = states[i];
    s.status = static_cast<SolveStatus>(static_cast<int64_t>(status[i]));
    s.b2 = norm2[i];
    if (!request.whole_cycles) s.end_cycles_at(request.solver.rtol);
    s.rounding2 = rounding[i] * rounding[i];
    s.active = s.status == SolveStatus::kMaxIter;
    s.concluded = !s.active;
    if (s.active) s.applications += static_cast<int64_t>(products[i]);
  }
}

/// glibc returns the top of the heap to the system once it exceeds twice the largest block ever freed. Vectors of some
/// 100 KB are then faulted in again for every product, which can double the time of a solve. A large block that is
/// freed untouched raises the bound, as the first large tensor of a training would.
void keep_top_of_heap() {
  [[maybe_unused]] static const bool done = [] {
    // Just below 32 MiB: for no larger block glibc raises that bound. Volatile, or the pair is optimised away.
    void* volatile block = std::malloc((size_t{32} << 20) - 8192);
    std::free(block);
    return true;
  }();
}

/// What comes of each sample: `largest` number of u, and `largest_scaled` of u before it was scaled back.
std::vector<SampleOutcome> outcomes_of(std::vector<SampleState>& states, const PreparedBatch& batch, bool guarded,
                                       const at::Tensor& largest_scaled, const at::Tensor& largest) {
  const auto host = at::stack({batch.status.to(largest.scalar_type()), batch.inconsistent.to(largest.scalar_type()),
                               largest_scaled, largest})
                        .to(at::kCPU, at::kDouble);
  const auto rows = host.accessor<double, 2>();
  const auto status_before = rows[0], inconsistent = rows[1], scaled = rows[2], whole = rows[3];
  const auto outcome = largest.scalar_type() == at::kFloat ? outcome_of<float, std::function<bool()>>
                                                           : outcome_of<double, std::function<bool()>>;
  std::vector<SampleOutcome> outcomes(states.size());
  for (size_t i = 0; i < states.size(); ++i) {
    const auto before = static_cast<SolveStatus>(static_cast<int64_t>(status_before[i]));
    if (before != SolveStatus::kMaxIter) outcomes[i] = zero_instead(before);
    else outcomes[i] = outcome(states[i], guarded, inconsistent[i] == 0.0, whole[i], [&] { return scaled[i] > 0.0; });
    if (std::isnan(outcomes[i].residual)) outcomes[i].residual = std::numeric_limits<double>::infinity();
  }
  return outcomes;
}

}  // namespace

SolveResult solve_with_tensors(const Operator& a, const at::Tensor& b, const SolveRequest& request) {
  const at::NoGradGuard no_grad;
  const at::NoTF32Guard full_precision;  // residuals below 1e-3 would be rounding
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
  // Before start_from(), after which b2() is that of the start's residual.
  fill_states(states, batch, space.b2(), request);
  if (batch.start.x.defined()) space.start_from(batch.start.x, batch.start.r);

  const auto run = [&](auto method) {
    iterate(space, method, states, solver.rtol, request.guarded);
    return a.project_solution(space.solution(method.x));
  };
  auto u = solver.method == Method::kGmres ? run(TensorGmres(space, solver.restart))
                                           : with_method(solver.method, solver.restart, space, run);
  const auto largest_scaled = largest_magnitude(u) * batch.takes_part;
  u = at::where(per_sample(batch.takes_part, b), u / batch.scale, at::zeros_like(b));
  const auto largest = largest_magnitude(u);
  const auto outcomes = outcomes_of(states, batch, request.guarded, largest_scaled, largest);
  const bool overflows = std::any_of(outcomes.begin(), outcomes.end(),
                                     [](const SampleOutcome& o) { return o.status == SolveStatus::kOverflow; });
  if (request.guarded && overflows) u = at::where(per_sample(largest.isfinite(), b), u, at::zeros_like(u));
  return {u.contiguous(), info_of(outcomes, b.scalar_type())};
}

}  // namespace prdp
