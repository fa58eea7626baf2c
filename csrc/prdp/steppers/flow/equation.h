#pragma once
#include <memory>

#include "prdp/steppers/flow/box.h"

namespace prdp {

enum class FlowAdvection {
  kCentral,  // second order; the skew-symmetric form, which conserves the energy
  kUpwind,   // first order, monotone
};
enum class FlowDiffusion { kImplicit, kExplicit };
/// Raise ValueError for names that do not exist.
FlowAdvection flow_advection_from_name(const std::string& name);
FlowDiffusion flow_diffusion_from_name(const std::string& name);

/// u_t + (u·∇)u + ∇p = ν Δu + f with ∇·u = 0 in a box, and how a time step treats it.
struct FlowEquation {
  std::shared_ptr<const FlowBox> box;
  double dt;
  at::Tensor nu;          // 0-dimensional
  at::Tensor force = {};  // (d,) or (batch or 1, d, *shape); undefined: none
  at::Tensor inflow = {}; // (d,) or (batch or 1, d, *shape with one cell along the open axis)
  FlowAdvection advection = FlowAdvection::kCentral;
  FlowDiffusion diffusion = FlowDiffusion::kImplicit;

  /// Raises ValueError or TypeError for what is out of range or does not fit the box.
  void check() const;
  /// And for what does not fit the state.
  void check(const at::Tensor& u) const;
  /// nu, force and inflow in the dtype and on the device of a state; force and inflow with all their axes.
  FlowEquation for_state(const at::Tensor& u) const;
  /// The tensors that may have a gradient.
  std::vector<at::Tensor> tensors() const { return {nu, force, inflow}; }
  FlowEquation with_tensors(at::TensorList tensors) const;
};

}  // namespace prdp
