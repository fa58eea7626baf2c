#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "prdp/solvers/solver.h"

namespace prdp {

/// Which of K iterates are stored for the reverse: the first one of every segment,
/// and all of the current segment.
struct StoredIterates {
  int64_t iterations, stride;

  StoredIterates(int64_t k, int64_t every) : iterations(k), stride(std::max<int64_t>(k, 1)) {
    if (every == kCheckpointSqrt) stride = static_cast<int64_t>(std::ceil(std::sqrt(static_cast<double>(k))));
    else if (every > 0) stride = std::min(every, k);
    stride = std::max<int64_t>(stride, 1);
  }
  int64_t segments() const { return (iterations + stride - 1) / stride; }
  /// Of the iterates in the segment at hand and of the segments' first ones.
  int64_t slots() const { return stride + segments(); }
};

/// Runs iterations forward, storing iterates as `plan` says, and then takes them back, one by one. The arithmetic does
/// not depend on the plan, so the result is the same to the last bit. `run` has start(), step(), save(slot),
/// load(slot, k) for the state after k iterations, and step_back(slot, k). This runs iteration k again from the state
/// in the slot, which has just been loaded, and takes the cotangents after it to those before it.
template <class Run>
void run_back(Run& run, const StoredIterates& plan) {
  const auto length = [&](int64_t segment) { return std::min(plan.stride, plan.iterations - segment * plan.stride); };
  run.start();
  for (int64_t segment = 0; segment < plan.segments(); ++segment) {
    run.save(plan.stride + segment);
    if (segment + 1 == plan.segments()) break;
    for (int64_t i = 0; i < plan.stride; ++i) run.step();
  }
  for (int64_t segment = plan.segments() - 1; segment >= 0; --segment) {
    run.load(plan.stride + segment, segment * plan.stride);
    for (int64_t i = 0; i < length(segment); ++i) {
      run.save(i);
      if (i + 1 < length(segment)) run.step();
    }
    for (int64_t i = length(segment) - 1; i >= 0; --i) {
      const int64_t k = segment * plan.stride + i;
      run.load(i, k);
      run.step_back(i, k);
    }
  }
}

}  // namespace prdp
