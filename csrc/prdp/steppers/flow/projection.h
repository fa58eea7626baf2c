#pragma once
#include "prdp/steppers/flow/counted_solves.h"
#include "prdp/steppers/flow/kernels.h"

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
/// The projection of u + added, where `added` is zero on the faces that are not free; `potential` is added to φ. Both
/// may be absent.
Projected project_sum(const FlowBox& box, const at::Tensor& u, const FlowParts& added, const at::Tensor& potential,
                      const SolveOptions& options, CombinedInfo& info);
/// The cotangent of u from that of the projected one, the same projection, and from that of φ, if it is defined: by one
/// adjoint solve. `refused`: samples whose status is not 0 have none; undefined: there are none.
struct ProjectVjp {
  at::Tensor u, on_free_faces;
};
ProjectVjp project_vjp(const FlowBox& box, at::Tensor cotangent, at::Tensor potential_bar, const at::Tensor& refused,
                       const SolveOptions& options, CombinedInfo& info);

/// A projection of which all but the solve are two launches; nothing where there are no kernels. The gradient is
/// added to `to_correct`. In reverse by an adjoint solve.
struct ProjectionLaunch {
  flow_kernels::UncorrectedVelocity to_project, to_correct;
  flow_kernels::CorrectionOptions how;
  bool reverse = false;
};
std::optional<flow_kernels::Corrected> project_by_kernels(const FlowBox& box, const ProjectionLaunch& by,
                                                          const SolveOptions& options, CombinedInfo& info);
/// The equation of the pressure is that of grad and div multiplied by this.
double scale_of_pressure(const FlowBox& box);

}  // namespace prdp
