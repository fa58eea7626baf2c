#pragma once
#include <optional>

#include "prdp/solvers/solver.h"
#include "prdp/steppers/flow/equation.h"
#include "prdp/steppers/flow/parts.h"

namespace prdp {

/// A largest ν: of all samples, or where they differ, of each, (samples,) in float64.
struct LargestViscosity {
  double of_all = 0;
  at::Tensor of_each = {};
};

}  // namespace prdp

/// The pieces of a step, one launch each, in place of some hundred tensor operations on a GPU. Where there is no
/// kernel, each returns nothing, and tensor operations take its place.
namespace prdp::flow_kernels {

/// Whether kernels may compute a step and its gradient: for plain tensors on a device that has a runtime, where
/// autograd does not record.
bool can_run(const at::Tensor& u);

/// u with its boundary values, (batch, d, *shape), inside of the same with ghosts; and for each sample 0, or the
/// SolveStatus why it cannot be advected: then all its values are zero.
struct PaddedVelocity {
  at::Tensor velocity, padded, status;
};
std::optional<PaddedVelocity> pad_velocity(const FlowEquation& equation, const at::Tensor& u);

/// dt (-(u·∇)u + ν Δu + f) on the free faces.
at::Tensor change(const FlowEquation& equation, const PaddedVelocity& start);

/// What the pressure is to correct.
struct UncorrectedVelocity {
  at::Tensor base = {};         // a velocity; undefined: none
  FlowParts added = {};         // to which this is added on the free faces; empty: nothing
  at::Tensor potential_bar = {}; // for the reverse: the cotangent of the potential; undefined: none
  at::Tensor refused = {};      // samples whose status is not 0 are zero; undefined: none
  at::Tensor status_of_solve = {};  // of a correction that is to be zero where the solve had no finite right-hand side
  at::Tensor share_by_nu = {};  // ν, where less than the whole pressure is taken off beyond a largest one
  LargestViscosity largest_nu = {};
};

/// factor · div u in the cells whose pressure is unknown, (batch, 1, *shape). For a solve: without its means.
at::Tensor divergence(const FlowBox& box, const UncorrectedVelocity& of, double factor, bool for_a_solve);

/// u - factor · grad φ, where φ is what the solve found, without its means.
struct Corrected {
  at::Tensor u, on_free_faces, potential;
};
struct CorrectionOptions {
  double factor;
  bool on_all_faces = false;  // else on the free ones
  bool wants_on_free_faces = false;
  at::Tensor before = {};  // is added to the potential; undefined: nothing
};
std::optional<Corrected> correct(const FlowBox& box, const UncorrectedVelocity& of, const at::Tensor& found,
                                 const CorrectionOptions& how);

/// The coefficients of I - ν dt Δ, (patterns, batch or 1, 2 d + 1, *shape).
at::Tensor diffusion_coefficients(const FlowEquation& equation, const at::Tensor& like);

/// The reports of solves as one; `refused` as above. Undefined parts where there is no kernel.
std::optional<SolveInfo> joined_reports(const std::vector<SolveInfo>& infos, const at::Tensor& refused);

/// What the gradient of ν needs of the implicit diffusion. Forward: the change, the result of balance() with its
/// potential, the result of diffuse(). Backward: λ and the cotangent of the potential. Empty if diffusion is explicit.
struct ImplicitPart {
  at::Tensor change = {}, balanced = {}, potential = {};
  FlowParts diffused = {}, lambda = {};
  at::Tensor potential_bar = {};
  LargestViscosity largest_nu = {};  // for which the whole pressure is taken off
};

/// The cotangents of u and of what the equation is made of, in the order of its tensors, from those of the velocity and
/// of its change: as `needed` says, u first. With all their axes, in one launch.
std::optional<std::vector<at::Tensor>> explicit_vjp(const FlowEquation& equation, const PaddedVelocity& start,
                                                    const at::Tensor& velocity_bar, const FlowParts& change_bar,
                                                    const ImplicitPart& part, at::IntArrayRef needed);

}  // namespace prdp::flow_kernels
