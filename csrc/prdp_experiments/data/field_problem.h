#pragma once
#include <ATen/ATen.h>

#include <vector>

#include "prdp/steppers/implicit_step.h"
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

/// What is observed of κ: snapshots of the states that it diffuses, u_t = ∇·(κ ∇u); or the pressures of a Darcy flow,
/// -∇·(κ ∇p) = f.
class FieldModel {
 public:
  /// `start`: (states, 1, *shape), the initial states, or the sources f. `scene` must outlive this object.
  FieldModel(const Scene& scene, at::Tensor start, SolveOptions options);
  FieldModel(const FieldModel&) = delete;

  /// For κ (*shape): (states, steps / every, 1, *shape), every `every` steps; (states, 1, 1, *shape) of a Darcy flow.
  /// Where the scene says so, states whose solve failed pass no gradient on.
  at::Tensor operator()(const at::Tensor& kappa);

  ImplicitStep& stepper() { return step_; }
  /// The pressures of the last κ, where the next solve may start; undefined for states in time.
  at::Tensor pressure;

 private:
  const Scene& scene_;
  at::Tensor start_;
  OperatorSpec assembled_;  // from κ once, for all steps
  ImplicitStep step_;
};

/// The problem of the task "field": find κ = exp(θ) from noisy observations.
struct FieldProblem {
  at::Tensor start;      // (states, 1, *shape): of FieldModel, known exactly
  at::Tensor snapshots;  // what is observed of the reference, with noise
  at::Tensor theta;      // (*shape): θ at the beginning, log(mean)
  at::Tensor reference;  // (*shape): κ to be found
};
/// `seed` draws the noise. The field and the states depend only on the scene.
FieldProblem make_field_problem(const Scene& scene, int64_t seed);

/// Those of the states (batch, steps + 1, 1, *shape) of a rollout that have snapshots; all of (batch, 1, 1, *shape) of
/// a Darcy flow.
at::Tensor observed(const at::Tensor& states, const Scene& scene);

/// The mean of |∇θ|² over the grid, by differences between neighbours.
at::Tensor roughness(const at::Tensor& theta, const Scene::Physics& physics);

}  // namespace prdp
