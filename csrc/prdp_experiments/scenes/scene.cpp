#include "prdp_experiments/scenes/scene.h"

#include <algorithm>
#include <cmath>
#include <numbers>

#include "prdp/steppers/equation_kinds.h"
#include "prdp_experiments/scenes/device.h"

namespace prdp {

namespace {

/// The equations of scenes alone, which make their steps themselves, and those of the library.
const EquationKind& kind_of(const std::string& equation) {
  static const std::vector<EquationKind> own{{"diffusion", /*periodic=*/true, /*channels=*/1, /*linearised=*/false},
                                             {"kolmogorov", true, kPerAxis, false},
                                             {"darcy", false, 1, false}};
  for (const auto& kind : own)
    if (kind.kind == equation) return kind;
  return equation_kind(equation);
}

}  // namespace

// The list of scene keys is made from a scene without an equation.
bool Scene::Physics::periodic() const { return !equation.empty() && kind_of(equation).periodic; }

int64_t Scene::Physics::channels() const {
  const int64_t channels = kind_of(equation).channels;
  return channels == kPerAxis ? static_cast<int64_t>(shape.size()) : channels;
}

Solver Scene::reference_solver() const {
  if (physics.direct_is_cheap()) return Direct{};
  // The errors of this one in space and time are far above that of its solves. Off the CPU an FFT is much faster.
  if (physics.is_kolmogorov())
    return device.is_cpu() ? Solver(CG{100, 1e-5, Preconditioner::multigrid()}) : Solver(Direct{});
  return GMRES{.restart = 20, .max_iter = 1000, .rtol = 1e-8};
}

Stepper Scene::stepper(Solver with) const {
  Equation equation{physics.equation, physics.shape, physics.lengths, {}};
  if (physics.equation != "poisson") {
    equation.parameters.insert(equation.parameters.begin(), physics.dt);
    equation.tensors = {at::scalar_tensor(physics.nu, at::kDouble)};
  }
  return {std::move(equation), options(std::move(with))};
}

SolveOptions Scene::options(Solver with) const { return {std::move(with), backward, {}, {}, on_failure, 0, 0, start}; }

void Scene::set_device(const std::string& name) { device = named_device(name); }

double Scene::learning_rate(int64_t update) const {
  if (training.cosine_updates) {
    const double part = std::min(1.0, static_cast<double>(update) / static_cast<double>(*training.cosine_updates));
    return training.learning_rate * (0.1 + 0.45 * (1.0 + std::cos(std::numbers::pi * part)));
  }
  const double periods = static_cast<double>(update) / static_cast<double>(training.decay_steps);
  return training.learning_rate * std::pow(training.decay, periods);
}

}  // namespace prdp
