#include "prdp_experiments/data/kolmogorov.h"

#include <numbers>

#include "prdp_experiments/data/data.h"

namespace prdp {

namespace {

Flow make_flow(const Scene::Physics& physics, const at::Device& device, FlowAdvection advection, SolveOptions options) {
  const auto lengths = physics.lengths.empty() ? std::vector<double>{1.0} : physics.lengths;
  auto box = std::make_shared<FlowBox>(physics.shape, std::vector{FlowBoundary::kPeriodic}, lengths, at::Tensor());
  return {FlowEquation{.box = std::move(box),
                       .dt = physics.dt,
                       .nu = at::scalar_tensor(physics.nu, at::kDouble),
                       .force = kolmogorov_force(physics).to(device),
                       .advection = advection},
          std::move(options)};
}

Scene::Physics finer(const Scene& scene, int64_t factor) {
  auto physics = scene.physics;
  physics.shape = scene.data.reference_shape;
  physics.dt /= static_cast<double>(factor);
  return physics;
}

}  // namespace

at::Tensor kolmogorov_force(const Scene::Physics& physics) {
  const int64_t ny = physics.shape[0], nx = physics.shape[1];
  const auto y = (at::arange(ny, at::TensorOptions().dtype(at::kDouble)) + 0.5) / ny;
  const auto along_x = physics.amplitude * (y * (2.0 * std::numbers::pi * static_cast<double>(physics.waves))).sin();
  const auto on_faces = along_x.unsqueeze(1).expand({ny, nx});
  return at::stack({on_faces, at::zeros_like(on_faces)}).unsqueeze(0);
}

Flow kolmogorov_step(const Scene& scene, SolveOptions options) {
  return make_flow(scene.physics, scene.device, FlowAdvection::kUpwind, std::move(options));
}

KolmogorovReference::KolmogorovReference(const Scene& scene)
    : shape_(scene.physics.shape),
      factor_(scene.data.reference_shape[0] / shape_[0]),
      flow_(make_flow(finer(scene, factor_), device_of_data(scene), FlowAdvection::kCentral,
                      SolveOptions{scene.reference_solver()})) {}

at::Tensor KolmogorovReference::step(at::Tensor u) {
  for (int64_t i = 0; i < factor_; ++i) u = converged_step(flow_, u);
  return u;
}

at::Tensor KolmogorovReference::coarse(const at::Tensor& u) const {
  const auto cells = u.reshape({u.size(0), 2, shape_[0], factor_, shape_[1], factor_});
  const auto low_in_x = cells.select(1, 0).select(-1, 0).mean(-2), low_in_y = cells.select(1, 1).select(-3, 0).mean(-1);
  return at::stack({low_in_x, low_in_y}, 1);
}

}  // namespace prdp
