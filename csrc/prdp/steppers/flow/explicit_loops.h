#pragma once
#include "prdp/steppers/flow/equation.h"

namespace prdp {

/// Whether loops compute a step and its gradient: for plain tensors on the CPU where autograd does not record.
bool flow_has_loops(const at::Tensor& u);

/// -(u·∇)u + ν Δu of a field with ghosts by loops on the CPU, in place of some fifty tensor operations. `padded` is
/// contiguous, (batch, d, *shape + 2).
at::Tensor advect_and_diffuse(const FlowEquation& equation, const at::Tensor& padded);

/// The cotangents of `padded` and of ν from that of the result.
struct ExplicitVjp {
  at::Tensor padded, nu;
};
ExplicitVjp advect_and_diffuse_vjp(const FlowEquation& equation, const at::Tensor& padded, const at::Tensor& cotangent);

/// dt Σ_axes |u| / dx, the largest of each sample, (batch,); NaN or Inf where u is not finite. For plain tensors on the
/// CPU.
at::Tensor courant_numbers_by_loops(const FlowEquation& equation, const at::Tensor& u);

}  // namespace prdp
