#include "prdp_experiments/training/training.h"

#include <c10/util/accumulate.h>
#include <torch/csrc/autograd/autograd.h>
#include <torch/nn/modules/container/any.h>

#include <cmath>

#include "prdp/autograd/detach_failed.h"
#include "prdp/controller/linear_schedule.h"
#include "prdp/controller/tolerance_controller.h"
#include "prdp/operators/navier_stokes_operator.h"
#include "prdp_experiments/data/data.h"
#include "prdp_experiments/data/fresh_data.h"
#include "prdp_experiments/networks/mlp.h"
#include "prdp_experiments/networks/resnet.h"
#include "prdp_experiments/networks/unet.h"
#include "prdp_experiments/networks/weights.h"
#include "prdp_experiments/scenes/device.h"
#include "prdp_experiments/training/field.h"
#include "prdp_experiments/training/fused_adam.h"
#include "prdp_experiments/training/loss.h"
#include "prdp_experiments/training/run.h"
#include "prdp_experiments/training/scene_step.h"
#include "prdp_experiments/training/state.h"

namespace prdp::train {

Refinement automatic() {
  Refinement refinement{"auto", [] { return std::make_unique<ToleranceController>(); }};
  refinement.watches_error = true;
  refinement.start = Start::kState;
  return refinement;
}

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

/// The scene's network with the weights that belong to the seed, in every language.
torch::nn::AnyModule make_network(const Scene& scene, int64_t seed) {
  using torch::nn::AnyModule;
  const auto& p = scene.physics;
  const auto& n = scene.network;
  const auto dim = static_cast<int64_t>(p.shape.size());
  torch::manual_seed(static_cast<uint64_t>(seed));
  auto network = n.kind == "mlp"      ? AnyModule(MLP(p.channels() * c10::multiply_integers(p.shape), n.hidden))
                 : n.kind == "resnet" ? AnyModule(ResNet(dim, p.channels(), n.blocks, n.width, p.periodic()))
                                      : AnyModule(UNet(dim, p.channels(), n.levels, n.width, p.periodic()));
  if (n.zero_output) {
    const torch::NoGradGuard no_grad;
    const auto parameters = network.ptr()->parameters();
    for (auto last = parameters.end() - 2; last != parameters.end(); ++last) last->zero_();
  }
  network.ptr()->to(scene.device, scene.dtype);  // drawn on the CPU, and so the same on every device
  return network;
}

using Steppers = std::vector<SceneStep>;

/// What training a network is about: the loss of a batch, and the metric.
struct Objective {
  std::function<at::Tensor(const at::Tensor& batch)> loss;
  std::function<double()> metric;
};

Objective emulator(const Scene& scene, Steppers& steppers, const Dataset& data, torch::nn::AnyModule& network) {
  const auto loss_of = [&](const at::Tensor& batch) {
    const auto u2 = steppers[0](network.forward(data.train_start.index_select(0, batch)));
    return loss(scene.training.loss, u2, data.train_end.index_select(0, batch));
  };
  const auto metric = [&] {
    auto u = data.valid_start;
    for (int64_t i = 0; i < scene.data.valid_steps; ++i) u = network.forward(u);
    return normalised_mse(u, data.valid_end).item<double>();
  };
  return {loss_of, metric};
}

Objective corrector(const Scene& scene, Steppers& steppers, const Dataset& data, torch::nn::AnyModule& network) {
  const auto corrected = [&](const SceneStep& stepper, const at::Tensor& u) {
    const auto coarse = without_mean_pressure(stepper(u));
    return coarse + network.forward(coarse);
  };
  const bool zero_grad = scene.on_failure == OnFailure::kZeroGrad;
  const auto loss_of = [&, corrected, zero_grad](const at::Tensor& batch) {
    auto u = data.train_start.index_select(0, batch);
    at::Tensor sum, worst;
    for (size_t i = 0; i < steppers.size(); ++i) {
      u = corrected(steppers[i], u);
      const auto& status = steppers[i].info()->status;
      worst = i == 0 ? status : at::minimum(worst, status);
      // The network's share of a prediction is no better than the coarse steps below it.
      const auto seen = zero_grad ? detach_failed(u, worst) : u;
      const auto reference =
          i + 1 < steppers.size() ? data.train_between.select(1, static_cast<int64_t>(i)) : data.train_end;
      const auto added = loss(scene.training.loss, seen, reference.index_select(0, batch));
      sum = i == 0 ? added : sum + added;
    }
    return sum;
  };
  auto solver = scene.solver;
  solver.max_iter = scene.data.valid_max_iter;
  const auto metric = [&, corrected, converged = scene_step(scene, solver)] {
    auto u = data.valid_start;
    for (int64_t i = 0; i < scene.data.valid_steps; ++i) u = corrected(converged, u);
    return normalised_mse(u.narrow(1, 0, 1), data.valid_end.narrow(1, 0, 1)).item<double>();
  };
  return {loss_of, metric};
}

Curves train_network(const Scene& scene, Run& run, Steppers& steppers, int64_t seed,
                     const std::filesystem::path& weights, const OnInterval& on_interval, const OnProgress& on_data) {
  TORCH_CHECK_VALUE(scene.network.python.empty(), "network: '", scene.network.python,
                    "' is a class in Python, which prdp_train cannot make; run prdp train ", scene.path);
  auto network = make_network(scene, seed);
  if (!weights.empty()) load_weights(weights, *network.ptr());
  auto data = make_dataset(scene, on_data);
  FreshData fresh(scene, data);
  const auto objective = scene.task == Scene::Task::kEmulator ? emulator(scene, steppers, data, network)
                                                              : corrector(scene, steppers, data, network);
  FusedAdam optimiser(network.ptr()->parameters(), scene.learning_rate(0));
  auto generator = make_generator(seed);
  const auto updates_of_epoch = (data.train_start.size(0) - 1) / scene.training.batch + 1;

  const auto updates = [&](int64_t update, const OnUpdate& on_update) {
    if (scene.data.fresh) {
      const auto samples = fresh.epoch(update / updates_of_epoch);
      std::tie(data.train_start, data.train_between, data.train_end) =
          std::tie(samples.train_start, samples.train_between, samples.train_end);
    }
    const auto order = shuffled(data.train_start.size(0), generator).to(scene.device);
    for (const auto& batch : order.split(scene.training.batch)) {
      for (auto& group : optimiser.param_groups()) group.options().set_lr(scene.learning_rate(update));
      optimiser.zero_grad();
      const auto error = objective.loss(batch);
      error.backward();
      optimiser.step();
      ++update;
      on_update(error.item<double>(), batch);
    }
  };
  const auto metric = [&] {
    const torch::NoGradGuard no_grad;
    return objective.metric();
  };
  auto& module = *network.ptr();
  const auto save_all = [&](TensorMap& tensors) { save(tensors, module, optimiser, generator); };
  const auto load_all = [&](Saved& saved, int64_t done) { load(saved, done, module, optimiser, generator); };
  // The metric is a mean of squares, relative to the reference, after so many steps; their errors add up.
  const auto error = [n = static_cast<double>(scene.data.valid_steps)](double squared) {
    return std::sqrt(squared) / n;
  };
  auto curves = run.go({updates, metric, error, save_all, load_all, updates_of_epoch}, on_interval);
  curves.weights = pack_weights(module);
  return curves;
}

/// What a task without a network has found, as weights.
std::string pack_theta(const at::Tensor& theta) {
  torch::nn::Module module;
  module.register_parameter("theta", theta.detach(), /*requires_grad=*/false);
  return pack_weights(module);
}

Curves train_parameters(const Scene& scene, Run& run, const SceneStep& stepper, const OnInterval& on_interval) {
  const auto problem = make_parameter_problem(scene);
  auto theta = problem.start.clone().requires_grad_();
  // What a user sees, who does not know θ; before the first solve nothing is explained yet.
  double misfit = 1.0;

  const auto updates = [&](int64_t update, const OnUpdate& on_update) {
    const auto u = stepper(at::matmul(theta, problem.modes).view({1, 1, -1}));
    const auto error = half_mse(u, problem.solution);
    const auto gradient = torch::autograd::grad({error}, {theta})[0];
    {
      const torch::NoGradGuard no_grad;
      theta.sub_(gradient, scene.learning_rate(update));
    }
    misfit = relative_error(u.detach(), problem.solution).item<double>();
    on_update(error.item<double>(), std::nullopt);
  };
  const auto metric = [&] { return relative_error(theta.detach(), problem.reference).item<double>(); };
  const auto save_theta = [&](TensorMap& tensors) { tensors["theta"] = theta; };
  const auto load_theta = [&](Saved& saved, int64_t) {
    theta.detach().copy_(saved.take("theta", theta.scalar_type(), theta.sizes()));
  };
  auto curves = run.go({updates, metric, [&](double) { return misfit; }, save_theta, load_theta}, on_interval);
  curves.weights = pack_theta(theta);
  return curves;
}

}  // namespace

Curves train(const Scene& scene, const Refinement& refinement, int64_t seed, const std::filesystem::path& weights,
             const OnInterval& on_interval, Checkpoint& checkpoint, const OnProgress& on_data) {
  check_device(scene.device);
  at::globalContext().setDeterministicCuDNN(true);  // a training that goes on gives the same bits
  TORCH_CHECK_VALUE(weights.empty() || scene.trains_network(), "weights: the scene '", scene.name,
                    "' trains no network");
  const Solver solver = refinement.direct ? Solver(Direct{}) : scene.solver;
  if (scene.task == Scene::Task::kField) {
    FieldTraining field(scene, solver, seed);
    auto curves = Run(scene, refinement, seed, checkpoint, {&field.stepper()}).go(field.task(), on_interval);
    curves.weights = pack_theta(field.theta());
    return curves;
  }
  Steppers steppers;
  for (int64_t i = 0; i < scene.executions(); ++i) steppers.push_back(scene_step(scene, solver));
  std::vector<StepperBase*> solves;
  for (const auto& step : steppers) solves.push_back(step.stepper.get());
  Run run(scene, refinement, seed, checkpoint, solves);
  return scene.task == Scene::Task::kParameters
             ? train_parameters(scene, run, steppers[0], on_interval)
             : train_network(scene, run, steppers, seed, weights, on_interval, on_data);
}

}  // namespace prdp::train
