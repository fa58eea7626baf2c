#pragma once
#include "prdp/scenes/data.h"

namespace prdp {

/// Random flows (samples, 3, Ny, Nx) to begin with, float64 (paper, appendix E): standard normal noise,
/// smoothed by one implicit heat step of ν Δt = 3e-3, brought to mean 0 and standard deviation 1 a sample
/// and component, then freed of its discrete divergence; the pressure is 0.
at::Tensor random_flow(const std::vector<int64_t>& shape, int64_t samples, int64_t seed);

/// Every second point of the last two axes, at the indices 1, 3, …
at::Tensor downsample(const at::Tensor& u);

/// The data of the task "corrector": trajectories of the converged equation on data.reference_shape,
/// down-sampled. Raises RuntimeError where a reference solve does not converge.
Dataset flow_dataset(const Scene& scene, const OnProgress& on_progress);

}  // namespace prdp
