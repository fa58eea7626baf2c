#include "prdp_experiments/data/data.h"

#include <ATen/CPUGeneratorImpl.h>
#include <ATen/core/grad_mode.h>

#include <numbers>

#include "prdp_experiments/data/darcy.h"
#include "prdp_experiments/data/data_cache.h"
#include "prdp_experiments/data/flow_data.h"

namespace prdp {

at::Generator make_generator(int64_t seed) { return at::detail::createCPUGenerator(static_cast<uint64_t>(seed)); }

at::Tensor shuffled(int64_t samples, at::Generator& generator) {
  return at::randperm(samples, generator, at::TensorOptions().dtype(at::kLong));
}

at::Device device_of_data(const Scene& scene) { return scene.physics.is_kolmogorov() ? scene.device : at::kCPU; }

namespace {

/// The unknowns' places on an axis, as parts of its length: i/N where it is periodic, (i + 1/2)/N in the centres of
/// cells, else between the boundary points, (i + 1)/(N + 1).
at::Tensor unknowns_on_axis(const Scene::Physics& physics, int64_t axis) {
  const int64_t n = physics.shape[axis];
  const bool between_points = !physics.periodic() && !physics.is_darcy();
  const double first = physics.is_darcy() ? 0.5 : between_points ? 1.0 : 0.0;
  const double dx = 1.0 / static_cast<double>(n + between_points);
  return (at::arange(n, at::TensorOptions().dtype(at::kDouble)) + first) * dx;
}

}  // namespace

at::Tensor fourier_series(const Scene::Physics& physics, int64_t samples, int64_t modes, int64_t seed,
                          at::ScalarType dtype) {
  auto generator = make_generator(seed);
  const auto dim = static_cast<int64_t>(physics.shape.size());
  const int64_t channels = physics.channels(), products = int64_t{1} << dim;
  const auto real = at::TensorOptions().dtype(at::kDouble);
  const auto amplitude = at::rand({samples, channels, modes, products}, generator, real) * 2.0 - 1.0;

  // wave[n·products + p]: the product whose axis d is a sine where bit d of p is 0, else a cosine.
  std::vector<at::Tensor> waves;
  for (int64_t n = 1; n <= modes; ++n)
    for (int64_t p = 0; p < products; ++p) {
      auto wave = at::ones({}, real);
      for (int64_t d = 0; d < dim; ++d) {
        const auto angle = unknowns_on_axis(physics, d) * (2.0 * std::numbers::pi * static_cast<double>(n));
        wave = wave.unsqueeze(-1) * ((p >> d) & 1 ? angle.cos() : angle.sin());
      }
      waves.push_back(wave.flatten());
    }
  const auto values = at::matmul(amplitude.reshape({samples * channels, modes * products}), at::stack(waves));
  std::vector<int64_t> shape{samples, channels};
  shape.insert(shape.end(), physics.shape.begin(), physics.shape.end());
  return values.reshape(shape).to(dtype);
}

void check_converged(const StepperBase& reference) {
  TORCH_CHECK(reference.converged(), "data: a reference solve stopped at a residual of ",
              reference.info()->residual.max().item<double>(), "; the scene's dt is too long for it");
}

namespace {

/// The first initial states of the scene, on the grid of the reference; those of the training come before those of the
/// validation.
at::Tensor starts(const Scene& scene, int64_t samples) {
  const auto& d = scene.data;
  TORCH_CHECK_VALUE(d.file.empty(), "data.file: only prdp train and prdp compare read it, with the states of ",
                    scene.path);
  if (scene.task == Scene::Task::kCorrector) {
    const auto u = random_flow(d.reference_shape, samples, d.seed, scene.physics.lengths);
    return scene.physics.is_kolmogorov() ? u.narrow(1, 0, 2) : u;
  }
  return fourier_series(scene.physics, samples, d.modes, d.seed, at::kDouble);
}

constexpr int64_t kSamplesAtOnce = 100;  // between two reports

/// The pressures of log κ, log κ itself, and so on in turn: what a network makes of pressures, and the solver of that.
at::Tensor in_turn(const Scene& scene, const at::Tensor& log_kappa, int64_t steps, const OnSteps& on_steps) {
  auto solve = darcy_step(scene.physics, SolveOptions{scene.reference_solver()});
  std::vector<at::Tensor> pressures;
  for (const auto& part : log_kappa.split(kSamplesAtOnce)) {
    pressures.push_back(solve(part));
    TORCH_CHECK(solve.converged(), "data: a reference solve stopped at a residual of ",
                solve.info()->residual.max().item<double>());
    on_steps(steps * part.size(0));
  }
  const auto p = at::cat(pressures);
  std::vector<at::Tensor> states;
  for (int64_t i = 0; i <= steps; ++i) states.push_back(i % 2 == 0 ? p : log_kappa);
  return at::stack(states, 1).to(scene.dtype);
}

/// The states of `steps` steps of the converged equation: (samples, steps + 1, channels, *shape).
at::Tensor follow(const Scene& scene, at::Tensor u, int64_t steps, const OnSteps& on_steps) {
  const at::NoGradGuard no_grad;
  if (scene.physics.is_darcy()) return in_turn(scene, u, steps, on_steps);
  if (scene.task == Scene::Task::kCorrector) return follow_flow(scene, u, steps, on_steps).to(scene.dtype);
  auto reference = scene.stepper(scene.reference_solver());
  std::vector<at::Tensor> parts;
  for (auto part : u.split(kSamplesAtOnce)) {
    std::vector<at::Tensor> states{part};
    for (int64_t i = 0; i < steps; ++i) {
      states.push_back(part = converged_step(reference, part));
      on_steps(part.size(0));
    }
    parts.push_back(at::stack(states, 1));
  }
  return at::cat(parts).to(scene.dtype);
}

/// Adds steps up towards `total`.
OnSteps counted(int64_t total, const OnProgress& on_progress) {
  return [=, done = int64_t{0}](int64_t steps) mutable {
    done += steps;
    if (on_progress) on_progress(done, total);
  };
}

}  // namespace

namespace {

at::Tensor at_time(const at::Tensor& states, int64_t t) { return states.select(1, t).contiguous(); }

Dataset training_samples(const Scene& scene, const at::Tensor& start, const OnSteps& on_steps) {
  const int64_t steps = scene.data.trained_steps;
  const auto states = follow(scene, start, steps, on_steps);
  Dataset data;
  data.train_start = at_time(states, 0);
  data.train_end = at_time(states, steps);
  if (scene.task == Scene::Task::kCorrector) data.train_between = states.slice(1, 1, steps).contiguous();
  return data;
}

}  // namespace

Dataset compute_training_samples(const Scene& scene, const OnProgress& on_progress) {
  const auto& d = scene.data;
  return training_samples(scene, starts(scene, d.train), counted((d.spin_up + d.trained_steps) * d.train, on_progress));
}

Dataset compute_dataset(const Scene& scene, const OnProgress& on_progress) {
  const auto& d = scene.data;
  const auto on_steps =
      counted((d.spin_up + d.trained_steps) * d.train + (d.spin_up + d.valid_steps) * d.valid, on_progress);
  const auto start = starts(scene, d.train + d.valid);
  auto data = training_samples(scene, start.narrow(0, 0, d.train), on_steps);
  const auto valid = follow(scene, start.narrow(0, d.train, d.valid), d.valid_steps, on_steps);
  data.valid_start = at_time(valid, 0);
  data.valid_end = at_time(valid, d.valid_steps);
  return data;
}

Dataset moved(Dataset data, const at::Device& device) {
  for (auto* part : {&data.train_start, &data.train_end, &data.valid_start, &data.valid_end, &data.train_between})
    if (part->defined()) *part = part->to(device);
  return data;
}

Dataset make_dataset(const Scene& scene, const OnProgress& on_progress) {
  const auto make = [&] { return compute_dataset(scene, on_progress); };
  const bool cheap = scene.physics.direct_is_cheap() || !scene.data.file.empty();
  return moved(cheap ? make() : cached_dataset(scene, make), scene.device);
}

namespace {

/// Of so many samples, the `first` one on.
at::Tensor trajectories_of(const char* who, const Scene& scene, int64_t first, int64_t samples, int64_t steps,
                           const OnProgress& on_progress) {
  TORCH_CHECK_VALUE(scene.trains_network(), who, ": the task trains no network and has no samples");
  TORCH_CHECK_VALUE(steps >= 0, who, ": steps must be >= 0, got ", steps);
  return follow(scene, starts(scene, scene.data.train + scene.data.valid).narrow(0, first, samples), steps,
                counted((scene.data.spin_up + steps) * samples, on_progress));
}

}  // namespace

at::Tensor validation_trajectories(const Scene& scene, int64_t steps, const OnProgress& on_progress) {
  const auto& d = scene.data;
  return trajectories_of("validation_trajectories", scene, d.train, d.valid, steps, on_progress);
}

at::Tensor all_trajectories(const Scene& scene, int64_t steps, const OnProgress& on_progress) {
  return trajectories_of("all_trajectories", scene, 0, scene.data.train + scene.data.valid, steps, on_progress);
}

ParameterProblem make_parameter_problem(const Scene& scene) {
  const at::NoGradGuard no_grad;
  const auto real = at::TensorOptions().dtype(at::kDouble);
  const int64_t n = scene.physics.shape[0];
  const auto x = unknowns_on_axis(scene.physics, 0);
  std::vector<at::Tensor> sines;
  for (size_t i = 1; i <= scene.parameters.start.size(); ++i)
    sines.push_back((x * (2.0 * std::numbers::pi * static_cast<double>(i))).sin());
  const auto modes = at::stack(sines);
  const auto reference = at::tensor(scene.parameters.reference, real);
  const auto solution = scene.stepper(Direct{})(at::matmul(reference, modes).view({1, 1, n}));
  const auto there = [&](const at::Tensor& t) { return t.to(scene.dtype).to(scene.device); };
  return {there(modes), there(at::tensor(scene.parameters.start, real)), there(reference), there(solution)};
}

}  // namespace prdp
