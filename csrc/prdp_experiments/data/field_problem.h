#pragma once
#include <ATen/ATen.h>

#include <vector>

#include "prdp_experiments/scenes/scene.h"

namespace prdp {

/// I - Δt ∇·(κ ∇) on a periodic grid, as stencil() takes it. Between two points κ is the mean of its
/// values there, so the operator is symmetric and a step keeps the sum of a state.
struct DiffusionStencil {
  at::Tensor coefficients;  // (1, 1 + 2 dim, *shape); differentiable
  std::vector<std::vector<int64_t>> offsets;
};
/// kappa: (*shape), positive, of one to three axes. `lengths` are the sides of the domain, as a Grid takes them.
DiffusionStencil diffusion_stencil(const at::Tensor& kappa, double dt, const std::vector<double>& lengths = {});

/// The problem of the task "field": find κ = exp(θ) in u_t = ∇·(κ ∇u) from noisy snapshots of its states.
struct FieldProblem {
  at::Tensor start;      // (states, 1, *shape): known exactly
  at::Tensor snapshots;  // (states, steps / every, 1, *shape): every `every` steps, with noise
  at::Tensor theta;      // (*shape): θ at the beginning, log(mean)
  at::Tensor reference;  // (*shape): κ to be found
};
/// `seed` draws the noise. The field and the states depend only on the scene.
FieldProblem make_field_problem(const Scene& scene, int64_t seed);

/// Those of the states (batch, steps + 1, 1, *shape) of a rollout that have snapshots.
at::Tensor observed(const at::Tensor& states, const Scene& scene);

/// The mean of |∇θ|² over the points, by differences between neighbours on the periodic grid.
at::Tensor roughness(const at::Tensor& theta, const std::vector<double>& lengths = {});

}  // namespace prdp
