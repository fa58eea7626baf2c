#pragma once
#include "prdp/steppers/flow/parts.h"
#include "prdp/steppers/flow/projection.h"

namespace prdp {

/// The change of the velocity by the explicit part, without the pressure that balances it, and dt times this pressure:
/// undefined where it is left to the projection after the diffusion. Differentiable.
///
/// A change that is a pure pressure gradient, as in a steady flow, must be removed first: next to walls, diffusion
/// turns a gradient into something that projection does not remove. Where all faces are free, diffusion and projection
/// commute, and the step is the same without this.
Projected balance(const FlowEquation& equation, const at::Tensor& change, const SolveOptions& options,
                  CombinedInfo& info);

/// The largest ν for which the whole of this pressure is taken off.
LargestViscosity largest_viscosity(const FlowEquation& equation, const at::Tensor& like);

/// The cotangents of the change and of ν from those of the result. ν's needs the change; both are undefined without.
struct BalanceVjp {
  FlowParts change;
  at::Tensor nu;
};
BalanceVjp balance_vjp(const FlowEquation& equation, const FlowParts& cotangent, const at::Tensor& potential_bar,
                       const at::Tensor& change, const SolveOptions& options, CombinedInfo& info);

}  // namespace prdp
