#pragma once
#include <functional>
#include <memory>

#include "prdp_experiments/data/darcy.h"
#include "prdp_experiments/data/kolmogorov.h"
#include "prdp_experiments/scenes/scene.h"

namespace prdp::train {

/// The step that a network is trained through, with its reports.
struct SceneStep {
  std::shared_ptr<StepperBase> stepper;
  std::function<at::Tensor(const at::Tensor&)> make;

  at::Tensor operator()(const at::Tensor& u) const { return make(u); }
  const std::optional<SolveInfo>& info() const { return stepper->info(); }
};

template <class Step>
SceneStep scene_step(Step step) {
  auto kept = std::make_shared<Step>(std::move(step));
  return {kept, [kept](const at::Tensor& u) { return (*kept)(u); }};
}
inline SceneStep scene_step(const Scene& scene, Solver solver) {
  if (scene.physics.is_darcy()) return scene_step(darcy_step(scene.physics, scene.options(std::move(solver))));
  if (scene.physics.is_kolmogorov()) return scene_step(kolmogorov_step(scene, scene.options(std::move(solver))));
  return scene_step(scene.stepper(std::move(solver)));
}

}  // namespace prdp::train
