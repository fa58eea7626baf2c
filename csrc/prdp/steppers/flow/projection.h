#pragma once
#include "prdp/steppers/flow/solves.h"

namespace prdp {

/// factor · div u in the cells whose pressure is unknown, zero in the others: (batch, 1, *shape). u has its boundary
/// values.
at::Tensor flow_divergence(const FlowBox& box, const at::Tensor& u, double factor = 1.0);

/// The velocity without divergence that is nearest to u: u - grad φ, where div grad φ = div u; and φ. u has its
/// boundary values. Differentiable.
struct Projected {
  at::Tensor u, potential;
};
Projected project(const FlowBox& box, const at::Tensor& u, const SolveOptions& options, CombinedInfo& info);
/// The cotangent of u from that of the projected one, the same projection, and from that of φ, if it is defined: by one
/// adjoint solve.
at::Tensor project_vjp(const FlowBox& box, const at::Tensor& cotangent, const at::Tensor& of_potential,
                       const SolveOptions& options, CombinedInfo& info);

}  // namespace prdp
