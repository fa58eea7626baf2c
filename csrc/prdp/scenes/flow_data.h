#pragma once
#include "prdp/scenes/data.h"

namespace prdp {

/// Random flows (samples, 3, Ny, Nx) to begin with, float64 (paper, appendix E): standard normal noise,
/// smoothed by one implicit heat step of ν Δt = 3e-3, brought to mean 0 and standard deviation 1 a sample
/// and component, then freed of its discrete divergence; the pressure is 0.
at::Tensor random_flow(const std::vector<int64_t>& shape, int64_t samples, int64_t seed);

/// Every second point of the last two axes, at the indices 1, 3, …
at::Tensor downsample(const at::Tensor& u);

/// Called with the number of samples that have just been taken a step on.
using OnSteps = std::function<void(int64_t)>;

/// The reference of the task "corrector": the states of `steps` steps of the converged equation from
/// `start` on data.reference_shape, the start included, down-sampled: (samples, steps + 1, 3, Ny, Nx).
/// Raises RuntimeError where a reference solve does not converge.
at::Tensor follow_flow(const Scene& scene, const at::Tensor& start, int64_t steps, const OnSteps& on_steps);

}  // namespace prdp
