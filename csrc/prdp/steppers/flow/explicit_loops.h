#pragma once
#include "prdp/steppers/flow/equation.h"

namespace prdp {

/// -(u·∇)u + ν Δu of a field with ghosts by loops on the CPU, in place of some fifty tensor operations. `padded` is
/// contiguous, (batch, d, *shape + 2).
at::Tensor advect_and_diffuse(const FlowEquation& equation, const at::Tensor& padded);

/// The cotangents of `padded` and of ν from that of the result.
struct ExplicitVjp {
  at::Tensor padded, nu;
};
ExplicitVjp advect_and_diffuse_vjp(const FlowEquation& equation, const at::Tensor& padded, const at::Tensor& cotangent);

}  // namespace prdp
