#pragma once
#include "prdp/steppers/flow/flow.h"
#include "prdp_experiments/scenes/scene.h"

namespace prdp {

/// The acceleration of a Kolmogorov flow on the grid of a scene, (1, 2, Ny, Nx) in float64: amplitude·sin(2π waves y/L)
/// along x.
at::Tensor kolmogorov_force(const Scene::Physics& physics);

/// A step of the coarse flow that a network corrects. Its advection is upwind: central differences would make waves
/// grow, at the Courant numbers at which a coarse flow is worth its place.
Flow kolmogorov_step(const Scene& scene, SolveOptions options);

/// The flow that data are made from, on the grid data.reference_shape and with central advection. One step of the scene
/// is so many of its steps that the Courant number stays the same.
class KolmogorovReference {
 public:
  explicit KolmogorovReference(const Scene& scene);

  /// One step of the scene. Raises RuntimeError if a solve does not converge.
  at::Tensor step(at::Tensor u);
  /// A state on the scene's grid: each value is the mean of those on the same face, so that the divergence of a coarse
  /// cell is the mean of those in it.
  at::Tensor coarse(const at::Tensor& u) const;

 private:
  std::vector<int64_t> shape_;  // of the scene
  int64_t factor_;
  Flow flow_;
};

}  // namespace prdp
