#include "prdp_experiments/training/field.h"

#include <cmath>

#include "prdp_experiments/training/loss.h"

namespace prdp::train {

FieldTraining::FieldTraining(const Scene& scene, Solver solver, int64_t seed)
    : scene_(scene),
      problem_(make_field_problem(scene, seed)),
      theta_(problem_.theta.clone().requires_grad_()),
      model_(scene, problem_.start, scene.options(std::move(solver))),
      optimiser_({theta_}, scene.learning_rate(0)) {}

void FieldTraining::update(int64_t number, const OnUpdate& on_update) {
  for (auto& group : optimiser_.param_groups()) group.options().set_lr(scene_.learning_rate(number));
  optimiser_.zero_grad();
  const auto squared = normalised_mse(model_(theta_.exp()), problem_.snapshots);
  const auto loss = squared + scene_.field.smoothing * roughness(theta_, scene_.physics);
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
        if (model_.pressure.defined()) tensors["pressure"] = model_.pressure;
        optimiser_.save(tensors);
      },
      [this](Saved& saved, int64_t updates) {
        theta_.detach().copy_(saved.take("theta", theta_.scalar_type(), theta_.sizes()));
        auto& p = model_.pressure;
        if (p.defined()) p = saved.take("pressure", p.scalar_type(), p.sizes()).to(p.device());
        optimiser_.load(saved, updates);
      },
  };
}

}  // namespace prdp::train
