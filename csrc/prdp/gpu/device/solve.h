#pragma once
#include "prdp/gpu/device/block_space.h"
#include "prdp/gpu/device/diffusion.h"
#include "prdp/gpu/device/upwind.h"
#include "prdp/solvers/solve_sample.h"

/// A solve of a batch in one launch: what solvers/solve_samples.cpp does on the CPU.
namespace prdp::gpu {

template <class Method, class S, class Space>
Method make_method(Space& space) {
  if constexpr (S::kRestart > 0) return Method(space, S::kRestart);
  else return Method(space);
}

template <class Method, class S, class Space>
SampleOutcome solve_sample_of(const SolveArguments<typename S::T>& of, int64_t sample, Space& space) {
  using T = typename S::T;
  const T magnitude = space.largest_given(of.arrays.b + sample * Space::unknowns());
  const GivenSample<T> given = of.arrays.sample(sample, Space::unknowns(), magnitude);
  const T start = given.x0 ? space.largest_given(given.x0) : T(0);
  const auto divides_by_zero = [&] {
    if constexpr (S::kDividesByDiagonal) return space.has_zero_diagonal();
    else return false;
  };
  SampleOutcome outcome;
  if (is_settled_beforehand(given.magnitude, start, [&] { return space.prepare_operator(); }, divides_by_zero, outcome))
    return outcome;
  if (!space.has_preconditioner()) return zero_instead(SolveStatus::kZeroDiagonal);
  auto method = make_method<Method, S>(space);
  return solve_sample(space, method, given);
}

/// The body of a kernel.
template <class Method, class S>
void solve_batch(const SolveArguments<typename S::T>& of, typename S::T* in_block) {
  using T = typename S::T;
  using Space = BlockSpace<S>;
  for_samples_of_team<S::kBlocks, S::kThreads>(of, of.batch, [&](int64_t sample, auto& team, int number) {
    Space space(team, typename S::A(of.a, sample), of, sample, in_block, of.memory + Space::kNumbersBeyond * number);
    const SampleOutcome outcome = solve_sample_of<Method, S>(of, sample, space);
    if (outcome.is_zero) space.fill_zero(of.arrays.u + sample * Space::unknowns());
    if (team.leads()) of.arrays.report.write(sample, outcome);
  });
}

}  // namespace prdp::gpu
