#pragma once
#include <cmath>
#include <cstdint>
#include <optional>

#include "prdp/kernels/direct_factors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/sample_space.h"

/// The CPU's way through a batch: sample after sample, each to its end.
namespace prdp {

/// Right-hand sides and results as plain arrays: b, x0 and u contiguous (batch, unknowns), the others
/// (batch,). `caps` gives each sample its own max_iter; null: all have `max_iter`. Null for x0: all start from zero.
template <class T>
struct SampleBatch {
  Method method;
  int64_t max_iter;
  double rtol;
  int64_t restart;
  const int64_t* caps;
  bool guarded;
  const T* b;
  const T* x0;
  T* u;
  int64_t* iterations;
  T* residual;
  int64_t* status;
  int64_t* applications;
};

/// Solves sample `s`. b is scaled by a power of two to the order of one, so that no square over- or
/// underflows and solve(2^k b) = 2^k solve(b) holds to the last bit.
template <class Kernel, class Iteration, class T>
void solve_sample(const Kernel& kernel, bool operator_is_finite, SampleSpace<Kernel>& space, Iteration& method,
                  const SampleBatch<T>& batch, int64_t s) {
  const int64_t n = kernel.unknowns();
  const T* b = batch.b + s * n;
  T* u = batch.u + s * n;
  std::array<SampleState, 1> states;
  SampleState& state = states[0];
  state.cap = batch.caps ? batch.caps[s] : batch.max_iter;

  [[maybe_unused]] const auto norm2 = [&](const T* v) { return kernels::loops<T>().dot(v, v, kernel.length()); };
  const auto finish = [&](SolveStatus status, int64_t iterations, double residual) {
    batch.status[s] = static_cast<int64_t>(status);
    batch.iterations[s] = iterations;
    batch.residual[s] = static_cast<T>(residual);
    batch.applications[s] = state.applications;
  };
  const auto hand_out_zeros = [&](SolveStatus status, double residual) {
    std::fill(u, u + n, T(0));
    finish(status, 0, residual);
  };
  const T magnitude = kernels::largest_magnitude(b, n);
  const T* x0 = traits(batch.method).is_direct || !batch.x0 ? nullptr : batch.x0 + s * n;
  if (!std::isfinite(magnitude) || (x0 && !std::isfinite(kernels::largest_magnitude(x0, n))))
    return hand_out_zeros(SolveStatus::kNonfiniteInput, std::numeric_limits<double>::infinity());
  if (!operator_is_finite)
    return hand_out_zeros(SolveStatus::kNonfiniteOperator, std::numeric_limits<double>::infinity());
  if (traits(batch.method).divides_by_diagonal && kernel.has_zero_diagonal())
    return hand_out_zeros(SolveStatus::kZeroDiagonal, 1.0);
  if (magnitude == T(0)) return hand_out_zeros(SolveStatus::kConverged, 0.0);

  const T scale = kernels::power_of_two_scale(magnitude);
  T* scaled = space.b();
  kernel.load(b, scale, scaled);
  bool consistent = true;
  if constexpr (kernels::kHasNullSpace<Kernel>) {
    const T whole = std::sqrt(norm2(scaled));
    consistent = kernel.inconsistency(scaled) <= consistency_bound<T>(batch.rtol) * whole;
    kernel.project(scaled);
    if (std::sqrt(norm2(scaled)) <= std::numeric_limits<T>::epsilon() * whole)
      return hand_out_zeros(SolveStatus::kInconsistent, 1.0);
  }
  space.begin(state);
  state.b2 = space.b2();
  if (x0) space.start_from(x0);
  iterate(space, method, states, batch.rtol, batch.guarded);
  if (x0) space.add_start(method.x);
  if constexpr (kernels::kHasNullSpace<Kernel>) kernel.project(method.x);
  kernel.store(method.x, T(1) / scale, u);
  if (!consistent && !is_failure(state.status)) state.status = SolveStatus::kInconsistent;
  if (batch.guarded && !kernels::all_finite(u, n)) {  // u leaves the range of the dtype only when scaled back
    hand_out_zeros(SolveStatus::kOverflow, 1.0);
  } else {
    finish(state.status, state.iterations, std::sqrt(state.residual2 / state.b2));
  }
  // Whatever a failure left in the padding must not reach the next sample.
  if (is_failure(static_cast<SolveStatus>(batch.status[s]))) space.clear();
}

/// Solves the samples [begin, end) on this thread.
template <class Kernel, class T>
void solve_samples(const Kernel& kernel, const SampleBatch<T>& batch, int64_t begin, int64_t end) {
  auto& workspace = kernels::Workspace<T>::local();
  const int64_t restart = std::min(batch.restart, kernel.unknowns());
  const bool starts = batch.x0 != nullptr;
  workspace.prepare(SampleSpace<Kernel>::vectors(starts) + vectors_of(batch.method, restart), kernel.length(),
                    kernel.halo());
  SampleSpace<Kernel> space(kernel, workspace, starts);
  with_method(batch.method, restart, space, [&](auto method) {
    const auto solve = [&](const Kernel& a, int64_t from, int64_t to) {
      const bool finite = a.operator_is_finite();
      std::optional<typename SampleSpace<Kernel>::Factors> factors;
      if (traits(batch.method).is_direct && finite) factors.emplace(a);
      space.set_operator(a, factors ? &*factors : nullptr);
      for (int64_t s = from; s < to; ++s) solve_sample(a, finite, space, method, batch, s);
    };
    if (kernel.is_shared()) return solve(kernel, begin, end);
    for (int64_t s = begin; s < end; ++s) solve(kernel.sample(s), s, s + 1);
  });
}

}  // namespace prdp
