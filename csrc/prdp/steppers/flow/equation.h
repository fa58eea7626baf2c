#pragma once
#include <memory>

#include "prdp/steppers/flow/box.h"

namespace prdp {

enum class FlowAdvection {
  kCentral,  // second order; the skew-symmetric form, which conserves the energy
  kUpwind,   // first order, monotone
};
enum class FlowDiffusion { kImplicit, kExplicit };
enum class FlowPressure {
  kIncremental,  // the explicit part is projected before the implicit diffusion, too
  kPlain,        // only the velocity after it
};
/// Raise ValueError for names that do not exist.
FlowAdvection flow_advection_from_name(const std::string& name);
FlowDiffusion flow_diffusion_from_name(const std::string& name);
FlowPressure flow_pressure_from_name(const std::string& name);

/// u_t + (u·∇)u + ∇p = ν Δu + f with ∇·u = 0 in a box, and how a time step treats it.
struct FlowEquation {
  /// Places in tensors(). Behind the first wall come the others, low and high along each axis.
  enum Tensor : size_t { kNu, kForce, kInflow, kFirstWall };

  std::shared_ptr<const FlowBox> box;
  double dt;
  at::Tensor nu;          // (), or (batch or 1,)
  at::Tensor force = {};  // (d,) or (batch or 1, d, *shape); undefined: none
  at::Tensor inflow = {}; // (d,) or (batch or 1, d, *shape with one cell along the open axis)
  /// Of the walls that move along themselves, low and high along each axis: (d,) or (batch or 1, d, *shape without the
  /// axis), undefined where a wall is at rest; empty if all are.
  std::vector<at::Tensor> wall_velocity = {};
  FlowAdvection advection = FlowAdvection::kCentral;
  FlowDiffusion diffusion = FlowDiffusion::kImplicit;
  FlowPressure pressure = FlowPressure::kIncremental;

  bool is_diffused_implicitly() const { return diffusion == FlowDiffusion::kImplicit; }
  /// Raises ValueError or TypeError for what is out of range or does not fit the box. Returns nu dt Σ 2/dx² of the
  /// largest nu.
  double check() const;
  /// And for what does not fit the state.
  double check(const at::Tensor& u) const;
  /// And, for so many steps, where one in the dtype of the state would lose its mean.
  void check_steps(const at::Tensor& u, int64_t steps) const;
  /// The tensors in the dtype and on the device of a state, with all their axes but for a nu without any.
  FlowEquation for_state(const at::Tensor& u) const;
  /// nu as numbers of the host, one or one for each sample; and the largest, 0 of none.
  std::vector<double> nu_values() const;
  double largest_nu() const;
  /// The gradient of nu, with its axes, from terms (batch or 1, …), which it sums. Of an equation for_state().
  at::Tensor nu_gradient(const at::Tensor& terms) const;
  /// The tensors that may have a gradient.
  std::vector<at::Tensor> tensors() const;
  FlowEquation with_tensors(at::TensorList tensors) const;
  /// The velocity of the wall at an end of an axis; undefined at rest.
  at::Tensor velocity_of_wall(int64_t axis, bool high) const;
};

/// "wall_velocity of side (0, 'high')", for the i-th of FlowEquation::wall_velocity.
std::string name_of_wall(size_t i);

}  // namespace prdp
