#include "prdp_experiments/data/field_problem.h"

#include <ATen/core/grad_mode.h>

#include "prdp/operators/stencil_operator.h"
#include "prdp/steppers/implicit_step.h"
#include "prdp_experiments/data/data.h"

namespace prdp {

namespace {

/// 1/dx of a periodic axis.
double per_length(const at::Tensor& field, const std::vector<double>& lengths, int64_t axis) {
  return static_cast<double>(field.size(axis)) / (lengths.empty() ? 1.0 : lengths[axis]);
}

}  // namespace

DiffusionStencil diffusion_stencil(const at::Tensor& kappa, double dt, const std::vector<double>& lengths) {
  const int64_t dim = kappa.dim();
  at::Tensor centre;
  std::vector<at::Tensor> sides;
  DiffusionStencil stencil{{}, {std::vector<int64_t>(dim, 0)}};
  for (int64_t axis = 0; axis < dim; ++axis) {
    const double n = per_length(kappa, lengths, axis);
    const auto after = (kappa + kappa.roll(-1, axis)) * (0.5 * dt * n * n);  // between a point and the next
    const auto before = after.roll(1, axis);
    centre = (centre.defined() ? centre : at::ones_like(kappa)) + after + before;
    sides.insert(sides.end(), {-before, -after});
    for (const int64_t step : {-1, 1}) {
      stencil.offsets.emplace_back(dim, 0);
      stencil.offsets.back()[axis] = step;
    }
  }
  sides.insert(sides.begin(), centre);
  stencil.coefficients = at::stack(sides).unsqueeze(0);
  return stencil;
}

FieldProblem make_field_problem(const Scene& scene, int64_t seed) {
  const at::NoGradGuard no_grad;
  const auto& f = scene.field;
  const auto shape = [&](const at::Tensor& one) { return one.reshape(scene.physics.shape); };
  const auto start = fourier_series(scene.physics, f.states, f.state_modes, f.seed, at::kDouble);
  auto pattern = shape(fourier_series(scene.physics, 1, f.modes, f.seed + 1, at::kDouble));
  pattern = pattern / pattern.abs().max();
  const auto theta = at::full_like(pattern, f.mean).log();
  const auto reference = (theta + f.contrast * pattern).exp();

  const auto [coefficients, offsets] = diffusion_stencil(reference, scene.physics.dt, scene.physics.lengths);
  ImplicitStep exact(stencil(coefficients, offsets, {Boundary::kPeriodic}), nullptr, scene.reference_solver());
  const auto states = observed(exact.rollout(start, f.steps), scene);
  TORCH_CHECK(exact.converged(), "data: a reference solve stopped at a residual of ",
              exact.info()->residual.max().item<double>(), "; the scene's dt is too long for it");
  auto generator = make_generator(seed);
  const auto noise = at::randn(states.sizes(), generator, states.options());
  const auto snapshots = states + f.noise * states.square().mean().sqrt() * noise;
  return {start.to(scene.dtype), snapshots.to(scene.dtype), theta.to(scene.dtype), reference.to(scene.dtype)};
}

at::Tensor observed(const at::Tensor& states, const Scene& scene) {
  return states.slice(1, scene.field.every, std::nullopt, scene.field.every);
}

at::Tensor roughness(const at::Tensor& theta, const std::vector<double>& lengths) {
  at::Tensor squares;
  for (int64_t axis = 0; axis < theta.dim(); ++axis) {
    const auto slope = (theta.roll(-1, axis) - theta) * per_length(theta, lengths, axis);
    squares = squares.defined() ? squares + slope.square() : slope.square();
  }
  return squares.mean();
}

}  // namespace prdp
