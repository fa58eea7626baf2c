#pragma once
#include <ATen/ATen.h>

#include <vector>

#include "prdp/scenes/scene.h"

namespace prdp {

/// I - Δt ∇·(κ ∇) on a periodic grid of side length 1, as `stencil` takes it. Between two points κ is the mean of
/// theirs, so that the operator is symmetric and keeps the sum of a state.
struct DiffusionStencil {
  at::Tensor coefficients;  // (1, 1 + 2 dim, *shape); differentiable
  std::vector<std::vector<int64_t>> offsets;
};
/// kappa: (*shape), positive, of one to three axes.
DiffusionStencil diffusion_stencil(const at::Tensor& kappa, double dt);

/// What the task "field" is about: κ = exp(θ) in u_t = ∇·(κ ∇u), from states of it that were observed with noise.
struct FieldProblem {
  at::Tensor start;      // (states, 1, *shape): known exactly
  at::Tensor snapshots;  // (states, steps / every, 1, *shape): every so many steps, with noise
  at::Tensor theta;      // (*shape): θ to begin with, log(mean)
  at::Tensor reference;  // (*shape): κ to be found
};
/// `seed` is that of the noise: the field and the states are the scene's alone.
FieldProblem make_field_problem(const Scene& scene, int64_t seed);

/// The states (batch, steps + 1, 1, *shape) of a rollout that have snapshots.
at::Tensor observed(const at::Tensor& states, const Scene& scene);

/// The mean over the points of |∇θ|², by differences between periodic neighbours.
at::Tensor roughness(const at::Tensor& theta);

}  // namespace prdp
