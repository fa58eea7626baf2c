#pragma once
#include "prdp_experiments/data/data.h"

namespace prdp {

/// Random initial flows (samples, 3, Ny, Nx) in float64 (paper, appendix E): standard normal noise, smoothed by one
/// implicit heat step with ν Δt = 3e-3, in units of the sides of the domain, then scaled to mean 0 and standard
/// deviation 1 for each sample and component, then projected to zero discrete divergence. The pressure is 0.
at::Tensor random_flow(const std::vector<int64_t>& shape, int64_t samples, int64_t seed,
                       const std::vector<double>& lengths = {});

/// Every second point of the last two axes, at the indices 1, 3, …
at::Tensor downsample(const at::Tensor& u);

/// Called with the number of samples that have just made a step.
using OnSteps = std::function<void(int64_t)>;

/// The reference of the task "corrector": `steps` converged steps on the grid data.reference_shape, brought to
/// physics.shape, after data.spin_up steps from `start`. Returns all states from there on, (samples, steps + 1,
/// channels, Ny, Nx). Raises RuntimeError if a reference solve does not converge.
at::Tensor follow_flow(const Scene& scene, const at::Tensor& start, int64_t steps, const OnSteps& on_steps);

}  // namespace prdp
