#include "training.h"

#include <torch/csrc/autograd/autograd.h>
#include <torch/optim/adam.h>

#include <chrono>

#include "prdp/controller/linear_schedule.h"
#include "prdp/networks/mlp.h"
#include "prdp/scenes/data.h"
#include "prdp/scenes/loss.h"

namespace prdp::train {

Refinement prdp(const Scene& scene) {
  return {"prdp", [settings = scene.prdp] { return std::make_unique<PRDPController>(settings); }};
}

Refinement schedule(int64_t start, int64_t step, int64_t maximum) {
  return {"schedule_" + std::to_string(start) + "_" + std::to_string(step),
          [=] { return std::make_unique<LinearSchedule>(start, step, maximum); }};
}

Refinement constant(int64_t k) {
  auto refinement = schedule(k, 0, k);
  refinement.label = "constant_" + std::to_string(k);
  return refinement;
}

Refinement direct() {
  auto refinement = constant(1);
  refinement.label = "direct";
  refinement.direct = true;
  return refinement;
}

namespace {

double per_sample(const at::Tensor& t) { return t.to(at::kDouble).mean().item<double>(); }

/// Adds up what the solves of an interval cost.
class Tally {
 public:
  explicit Tally(Curves& curves) : curves_(curves) {}

  void begin(int64_t k) {
    k_ = k;
    updates_ = 0;
    iterations_ = applications_ = 0.0;
    started_ = std::chrono::steady_clock::now();
  }
  void add(const Stepper& stepper) {
    ++updates_;
    iterations_ += per_sample(stepper.info()->iterations);
    applications_ += per_sample(stepper.info()->operator_applications);
    if (const auto adjoint = stepper.adjoint_info()) applications_ += per_sample(adjoint->operator_applications);
  }
  void end() {
    const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - started_;
    curves_.max_iter.push_back(k_);
    curves_.budget.push_back(k_ * updates_);
    curves_.iterations.push_back(iterations_);
    curves_.operator_applications.push_back(applications_);
    curves_.seconds.push_back(elapsed.count());
  }

 private:
  Curves& curves_;
  int64_t k_ = 0, updates_ = 0;
  double iterations_ = 0.0, applications_ = 0.0;
  std::chrono::steady_clock::time_point started_;
};

/// The scene's step and the controller that gives it K.
struct Physics {
  Stepper stepper;
  std::unique_ptr<Controller> controller;

  Physics(const Scene& scene, const Refinement& refinement)
      : stepper(scene.stepper(refinement.direct ? Solver(Direct{}) : scene.solver)),
        controller(refinement.controller()) {
    stepper.set_max_iter(controller->max_iter());
  }
  void refine(double metric) {
    controller->step(metric, stepper.converged());
    stepper.set_max_iter(controller->max_iter());
  }
};

Curves train_emulator(const Scene& scene, const Refinement& refinement, int64_t seed,
                      const OnInterval& on_interval) {
  const auto data = make_dataset(scene);
  torch::manual_seed(static_cast<uint64_t>(seed));
  MLP network(data.train_start[0].numel(), scene.network.hidden);
  network->to(scene.dtype);
  Physics physics(scene, refinement);
  torch::optim::Adam optimiser(network->parameters(), scene.learning_rate(0));
  auto generator = make_generator(seed);

  const auto validate = [&] {
    const torch::NoGradGuard no_grad;
    return normalised_mse(network(network(data.valid_start)), data.valid_end).item<double>();
  };
  Curves curves;
  Tally tally(curves);
  curves.metric.push_back(validate());
  physics.refine(curves.metric.back());
  for (int64_t epoch = 0; epoch < scene.training.epochs; ++epoch) {
    tally.begin(physics.stepper.max_iter());
    for (const auto& batch : shuffled(data.train_start.size(0), generator).split(scene.training.batch)) {
      const auto update = static_cast<int64_t>(curves.update_loss.size());
      for (auto& group : optimiser.param_groups()) group.options().set_lr(scene.learning_rate(update));
      optimiser.zero_grad();
      const auto u2 = physics.stepper(network(data.train_start.index_select(0, batch)));
      const auto error = loss(scene.training.loss, u2, data.train_end.index_select(0, batch));
      error.backward();
      optimiser.step();
      curves.update_loss.push_back(error.item<double>());
      tally.add(physics.stepper);
    }
    tally.end();
    curves.metric.push_back(validate());
    physics.refine(curves.metric.back());
    on_interval(epoch + 1, curves.metric.back(), physics.stepper.max_iter());
  }
  return curves;
}

Curves train_parameters(const Scene& scene, const Refinement& refinement, const OnInterval& on_interval) {
  const auto problem = make_parameter_problem(scene);
  Physics physics(scene, refinement);
  auto theta = problem.start.clone().requires_grad_();
  const auto metric = [&] { return relative_error(theta.detach(), problem.reference).item<double>(); };
  Curves curves;
  Tally tally(curves);
  curves.metric.push_back(metric());
  physics.refine(curves.metric.back());
  for (int64_t update = 0; update < scene.training.updates; ++update) {
    tally.begin(physics.stepper.max_iter());
    const auto u = physics.stepper(at::matmul(theta, problem.modes).view({1, 1, -1}));
    const auto error = half_mse(u, problem.solution);
    const auto gradient = torch::autograd::grad({error}, {theta})[0];
    {
      const torch::NoGradGuard no_grad;
      theta -= scene.learning_rate(update) * gradient;
    }
    curves.update_loss.push_back(error.item<double>());
    tally.add(physics.stepper);
    tally.end();
    curves.metric.push_back(metric());
    physics.refine(curves.metric.back());
    on_interval(update + 1, curves.metric.back(), physics.stepper.max_iter());
  }
  return curves;
}

}  // namespace

Curves train(const Scene& scene, const Refinement& refinement, int64_t seed, const OnInterval& on_interval) {
  return scene.task == Scene::Task::kEmulator
             ? train_emulator(scene, refinement, seed, on_interval)
             : train_parameters(scene, refinement, on_interval);
}

}  // namespace prdp::train
