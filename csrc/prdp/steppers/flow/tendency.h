#pragma once
#include "prdp/steppers/flow/equation.h"

namespace prdp {

/// u with what the boundary prescribes: the inflow at the inlet, zero on walls and obstacles.
at::Tensor with_boundary_values(const FlowEquation& equation, const at::Tensor& u);

/// u (batch, d, *shape) with a ghost cell beyond each end of each axis, which makes all differences the same as inside.
at::Tensor with_ghosts(const FlowEquation& equation, const at::Tensor& u);

/// -(u·∇)u + ν Δu + f on the free faces, zero on all others; u has its boundary values. Differentiable.
at::Tensor tendency(const FlowEquation& equation, const at::Tensor& u);

/// The cotangents of u and of what the equation is made of from that of the tendency, by loops. With all their axes.
struct TendencyVjp {
  at::Tensor u, nu, force, inflow;
  std::vector<at::Tensor> wall_velocity;
};
TendencyVjp tendency_vjp(const FlowEquation& equation, const at::Tensor& u, const at::Tensor& cotangent);
/// The same for with_boundary_values(): of u and of the inflow.
struct BoundaryVjp {
  at::Tensor u, inflow;
};
BoundaryVjp boundary_values_vjp(const FlowEquation& equation, const at::Tensor& cotangent);

/// dt Σ_axes |u| / dx, the largest of each sample, (batch,); NaN where u has one.
at::Tensor courant_numbers(const FlowEquation& equation, const at::Tensor& u);

}  // namespace prdp
