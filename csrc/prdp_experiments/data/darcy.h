#pragma once
#include "prdp/steppers/implicit_step.h"
#include "prdp_experiments/scenes/scene.h"

namespace prdp {

/// -∇·(κ ∇) for κ (batch or 1, *shape), on the cells of the scene's box with zeros on its sides.
OperatorSpec darcy_operator(const at::Tensor& kappa, const Scene::Physics& physics);

/// f of an emulator, for which pressures are of the order of one in a box of length 1.
inline constexpr double kDarcySource = 10.0;

/// From log κ, (batch, 1, *shape), to the pressures p of -∇·(κ ∇p) = f: what the network of an emulator is trained
/// through.
ImplicitStep darcy_step(const Scene::Physics& physics, SolveOptions options);

}  // namespace prdp
