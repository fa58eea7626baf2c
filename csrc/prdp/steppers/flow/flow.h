#pragma once
#include <map>
#include <utility>

#include "prdp/steppers/flow/equation.h"
#include "prdp/steppers/stepper.h"
#include "prdp/steppers/steppers.h"

namespace prdp {

/// An end of an axis of the box.
enum class FlowEnd { kLow, kHigh };
struct FlowSide {
  int64_t axis;
  FlowEnd end;
  auto operator<=>(const FlowSide&) const = default;
};

/// What a flow has beside its grid, viscosity and time step.
struct FlowSettings {
  std::vector<FlowBoundary> boundary{FlowBoundary::kPeriodic};  // one for all axes, or one per axis
  Length length = 1.0;
  at::Tensor obstacle{};  // bool (*shape), or (batch or 1, *shape) for one of each sample; true in solid cells
  at::Tensor force{};     // (d,) or (batch or 1, d, *shape); may get a gradient
  at::Tensor inflow{};  // for an open axis: (d,) or (batch or 1, d, *shape with one cell along it); may get a gradient
  FlowAdvection advection = FlowAdvection::kCentral;
  FlowDiffusion diffusion = FlowDiffusion::kImplicit;
  /// Of walls that move along themselves: (d,) or (batch or 1, d, *shape without the axis); may get a gradient.
  std::map<FlowSide, at::Tensor> wall_velocity{};
  FlowPressure pressure = FlowPressure::kIncremental;
};

/// One step of incompressible flow by projection (Chorin 1968) in 2D or 3D: u_t + (u·∇)u + ∇p = ν Δu + f, ∇·u = 0.
/// States are (batch, d, *shape); component c lies on the low face of its own axis, and channel 0 is the velocity
/// along x, the last axis. Advection is explicit Euler.
class Flow : public StepperBase {
 public:
  /// Raises ValueError or TypeError for what does not fit together, before any work.
  Flow(std::vector<int64_t> shape, Viscosity nu, double dt, FlowSettings settings = {},
       Solver solver = CG{100, kDefaultRtol, Preconditioner::multigrid()}, Backward backward = Backward::kImplicit);
  Flow(FlowEquation equation, SolveOptions options);

  at::Tensor operator()(const at::Tensor& u);
  /// The next state and the pressure of the step, (batch, 1, *shape).
  std::pair<at::Tensor, at::Tensor> step_and_pressure(const at::Tensor& u);
  /// Returns all states, u included: (batch, steps + 1, d, *shape). info() and adjoint_info() then hold tensors
  /// (batch, steps). It keeps one state per step for the backward pass.
  at::Tensor rollout(const at::Tensor& u, int64_t steps);

  /// The nearest velocity with the boundary values and without divergence.
  at::Tensor project(const at::Tensor& u) const;
  /// The pressure of the step from u, (batch, 1, *shape).
  at::Tensor pressure(const at::Tensor& u) const;
  /// div u of u with the boundary values, (batch, 1, *shape). It is zero in solid cells, and in the last cells before
  /// an open end, whose high faces take what mass conservation gives.
  at::Tensor divergence(const at::Tensor& u) const;

 private:
  FlowEquation equation_;
};

/// The same for a FlowEquation and its options.
at::Tensor flow_project(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options);
at::Tensor flow_pressure(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options);
at::Tensor flow_divergence_of_state(const FlowEquation& equation, const at::Tensor& u);

}  // namespace prdp
