#include "prdp_experiments/training/field.h"

#include <cmath>

#include "prdp/autograd/detach_failed.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp_experiments/training/loss.h"

namespace prdp::train {

FieldTraining::FieldTraining(const Scene& scene, Solver solver, int64_t seed)
    : scene_(scene),
      problem_(make_field_problem(scene, seed)),
      theta_(problem_.theta.clone().requires_grad_()),
      step_([this](const at::Tensor&) { return assembled_; }, nullptr, scene.options(std::move(solver))),
      optimiser_({theta_}, scene.learning_rate(0)) {}

void FieldTraining::update(int64_t number, const OnUpdate& on_update) {
  for (auto& group : optimiser_.param_groups()) group.options().set_lr(scene_.learning_rate(number));
  optimiser_.zero_grad();
  const auto [coefficients, offsets] = diffusion_stencil(theta_.exp(), scene_.physics.dt, scene_.physics.lengths);
  assembled_ = stencil(coefficients, offsets, {Boundary::kPeriodic});
  auto states = step_.rollout(problem_.start, scene_.field.steps);
  if (scene_.on_failure == OnFailure::kZeroGrad) states = detach_failed(states, step_.info()->status);
  const auto squared = normalised_mse(observed(states, scene_), problem_.snapshots);
  const auto loss = squared + scene_.field.smoothing * roughness(theta_, scene_.physics.lengths);
  loss.backward();
  optimiser_.step();
  misfit_ = std::sqrt(squared.item<double>());
  on_update(loss.item<double>(), std::nullopt);
}

Task FieldTraining::task() {
  return {
      [this](int64_t number, const OnUpdate& on_update) { update(number, on_update); },
      [this] { return relative_error(theta_.detach().exp(), problem_.reference).item<double>(); },
      [this](double) { return misfit_; },
      [this](TensorMap& tensors) {
        tensors["theta"] = theta_;
        optimiser_.save(tensors);
      },
      [this](Saved& saved, int64_t updates) {
        theta_.detach().copy_(saved.take("theta", theta_.scalar_type(), theta_.sizes()));
        optimiser_.load(saved, updates);
      },
  };
}

}  // namespace prdp::train
