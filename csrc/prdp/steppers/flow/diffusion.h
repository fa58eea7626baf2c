#pragma once
#include "prdp/steppers/flow/counted_solves.h"
#include "prdp/steppers/flow/parts.h"

namespace prdp {

/// I - ν dt Δ, of all channels or of each.
std::vector<OperatorSpec> diffusion_operators(const FlowEquation& equation, const at::Tensor& like);

/// (I - ν dt Δ)⁻¹ of a change of the velocity that is zero on the faces which are not free. Differentiable. Where
/// kernels take it on, what a preconditioner leaves on the other faces is still there.
FlowParts diffuse(const FlowEquation& equation, const std::vector<OperatorSpec>& operators, const at::Tensor& change,
                  SolveOptions options, CombinedInfo& info);
/// The cotangents of `change` and of ν from that of the result. ν's is undefined without the result.
struct DiffuseVjp {
  FlowParts change;
  at::Tensor nu;
};
DiffuseVjp diffuse_vjp(const FlowEquation& equation, const std::vector<OperatorSpec>& operators,
                       const at::Tensor& cotangent, const at::Tensor& result, const SolveOptions& options,
                       CombinedInfo& info);

}  // namespace prdp
