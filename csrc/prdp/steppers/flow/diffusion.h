#pragma once
#include "prdp/steppers/flow/solves.h"

namespace prdp {

/// (I - ν dt Δ)⁻¹ of a change of the velocity that is zero on the faces which are not free. Differentiable.
at::Tensor diffuse(const FlowEquation& equation, const at::Tensor& change, const SolveOptions& options,
                   CombinedInfo& info);
/// The cotangents of `change` and of ν from that of the result. ν's is undefined without the result.
struct DiffuseVjp {
  at::Tensor change, nu;
};
DiffuseVjp diffuse_vjp(const FlowEquation& equation, const at::Tensor& cotangent, const at::Tensor& result,
                       const SolveOptions& options, CombinedInfo& info);

}  // namespace prdp
