#include "prdp_experiments/data/field_problem.h"

#include <ATen/core/grad_mode.h>

#include "prdp/autograd/detach_failed.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp_experiments/data/darcy.h"
#include "prdp_experiments/data/data.h"

namespace prdp {

namespace {

/// 1/dx of an axis of cells.
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

FieldModel::FieldModel(const Scene& scene, at::Tensor start, SolveOptions options)
    : pressure(scene.physics.is_darcy() ? at::zeros_like(start) : at::Tensor()),
      scene_(scene),
      start_(std::move(start)),
      step_([this](const at::Tensor&) { return assembled_; },
            scene.physics.is_darcy() ? ImplicitStep::RhsAt([this](const at::Tensor&) { return start_; }) : nullptr,
            std::move(options)) {}

at::Tensor FieldModel::operator()(const at::Tensor& kappa) {
  const auto& physics = scene_.physics;
  at::Tensor states;
  if (physics.is_darcy()) {
    assembled_ = darcy_operator(kappa.unsqueeze(0), physics);
    states = step_(pressure);
    pressure = states.detach();
    states = states.unsqueeze(1);
  } else {
    const auto [coefficients, offsets] = diffusion_stencil(kappa, physics.dt, physics.lengths);
    assembled_ = stencil(coefficients, offsets, {Boundary::kPeriodic});
    states = step_.rollout(start_, scene_.field.steps);
  }
  if (scene_.on_failure == OnFailure::kZeroGrad) states = detach_failed(states, step_.info()->status);
  return observed(states, scene_);
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

  FieldModel exact(scene, start, SolveOptions{scene.reference_solver()});
  const auto states = exact(reference);
  TORCH_CHECK(exact.stepper().converged(), "data: a reference solve stopped at a residual of ",
              exact.stepper().info()->residual.max().item<double>(),
              scene.physics.is_darcy() ? "" : "; the scene's dt is too long for it");
  auto generator = make_generator(seed);
  const auto noise = at::randn(states.sizes(), generator, states.options());
  const auto snapshots = states + f.noise * states.square().mean().sqrt() * noise;
  const auto there = [&](const at::Tensor& t) { return t.to(scene.dtype).to(scene.device); };
  return {there(start), there(snapshots), there(theta), there(reference)};
}

at::Tensor observed(const at::Tensor& states, const Scene& scene) {
  if (scene.physics.is_darcy()) return states;
  return states.slice(1, scene.field.every, std::nullopt, scene.field.every);
}

at::Tensor roughness(const at::Tensor& theta, const Scene::Physics& physics) {
  auto sum = at::zeros({}, theta.options());
  for (int64_t axis = 0; axis < theta.dim(); ++axis) {
    if (theta.size(axis) == 1) continue;  // no slope, and no mean of none
    const auto after = physics.periodic() ? theta.roll(-1, axis) : theta.slice(axis, 1);
    const auto here = physics.periodic() ? theta : theta.slice(axis, 0, -1);
    sum = sum + ((after - here) * per_length(theta, physics.lengths, axis)).square().mean();
  }
  return sum;
}

}  // namespace prdp
