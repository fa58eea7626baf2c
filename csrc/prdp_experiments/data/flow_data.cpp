#include "prdp_experiments/data/flow_data.h"

#include <numbers>

#include "prdp/grid/grid.h"
#include "prdp_experiments/data/kolmogorov.h"

namespace prdp {

namespace {

constexpr int64_t kY = 0, kX = 1;  // the grid's axes
constexpr int64_t kSamplesAtOnce = 25;
constexpr double kSmoothing = 3e-3;  // ν Δt

/// Eigenvalues of the periodic five-point Laplacian, as at::fft_rfft2 orders them.
at::Tensor laplacian_symbol(const Grid& grid) {
  const auto along = [&](int64_t axis, int64_t waves) {
    const auto k = at::arange(waves, at::TensorOptions().dtype(at::kDouble));
    const auto n = static_cast<double>(grid.shape()[axis]);
    return -((k * (std::numbers::pi / n)).sin() * (2.0 * n / grid.length(axis))).square();
  };
  return along(kY, grid.shape()[kY]).unsqueeze(1) + along(kX, grid.shape()[kX] / 2 + 1);
}

/// v with its Fourier coefficients divided by `symbol`.
at::Tensor divide_modes(const at::Tensor& v, const at::Tensor& symbol) {
  return at::fft_irfft2(at::fft_rfft2(v) / symbol, v.sizes().slice(v.dim() - 2));
}

/// u - G φ with D G φ = D u.
at::Tensor without_divergence(const at::Tensor& u, const Grid& grid) {
  const auto symbol = laplacian_symbol(grid);
  symbol[0][0] = 1.0;  // the mean of φ, which G does not see
  const auto divergence =
      forward_difference(u.narrow(1, 0, 1), grid, kX) + forward_difference(u.narrow(1, 1, 1), grid, kY);
  const auto phi = divide_modes(divergence, symbol);
  return u - at::cat({backward_difference(phi, grid, kX), backward_difference(phi, grid, kY)}, 1);
}

}  // namespace

at::Tensor random_flow(const std::vector<int64_t>& shape, int64_t samples, int64_t seed,
                       const std::vector<double>& lengths) {
  const Grid unit("random_flow", shape, Boundary::kPeriodic), grid("random_flow", shape, Boundary::kPeriodic, lengths);
  auto generator = make_generator(seed);
  const auto real = at::TensorOptions().dtype(at::kDouble);
  const auto symbol = laplacian_symbol(unit);
  auto u = divide_modes(at::randn({samples, 2, shape[0], shape[1]}, generator, real), 1.0 - kSmoothing * symbol);
  u = u - u.mean({-2, -1}, /*keepdim=*/true);
  u = u / u.square().mean({-2, -1}, /*keepdim=*/true).sqrt();
  const auto pressure = at::zeros({samples, 1, shape[0], shape[1]}, real);
  return at::cat({without_divergence(u, grid), pressure}, 1);
}

at::Tensor downsample(const at::Tensor& u) { return u.slice(-2, 1, std::nullopt, 2).slice(-1, 1, std::nullopt, 2); }

namespace {

/// A step of the scene on the finer grid, and a state of that on the scene's grid.
struct Reference {
  std::function<at::Tensor(const at::Tensor&)> step, coarse;
};

Reference make_reference(const Scene& scene) {
  if (scene.physics.is_kolmogorov()) {
    const auto flow = std::make_shared<KolmogorovReference>(scene);
    return {[flow](const at::Tensor& u) { return flow->step(u); },
            [flow](const at::Tensor& u) { return flow->coarse(u); }};
  }
  auto fine = scene;
  fine.physics.shape = scene.data.reference_shape;
  const auto stepper = std::make_shared<Stepper>(fine.stepper(fine.reference_solver()));
  return {[stepper](const at::Tensor& u) { return converged_step(*stepper, u); }, downsample};
}

}  // namespace

at::Tensor follow_flow(const Scene& scene, const at::Tensor& start, int64_t steps, const OnSteps& on_steps) {
  const auto reference = make_reference(scene);
  std::vector<at::Tensor> parts;
  for (auto u : start.to(device_of_data(scene)).split(kSamplesAtOnce)) {
    std::vector<at::Tensor> states;
    for (int64_t i = -scene.data.spin_up; i <= steps; ++i) {
      if (i >= 0) states.push_back(reference.coarse(u));
      if (i == steps) break;
      u = reference.step(u);
      on_steps(u.size(0));
    }
    parts.push_back(at::stack(states, 1).cpu());
  }
  return at::cat(parts);
}

}  // namespace prdp
