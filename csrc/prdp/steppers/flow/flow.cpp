#include "prdp/steppers/flow/flow.h"

#include "prdp/steppers/flow/projection.h"
#include "prdp/steppers/flow/rollout.h"
#include "prdp/steppers/flow/step_node.h"
#include "prdp/steppers/flow/tendency.h"

namespace prdp {

namespace {

FlowEquation make_equation(std::vector<int64_t> shape, Viscosity nu, double dt, FlowSettings s) {
  auto box = std::make_shared<FlowBox>(std::move(shape), s.boundary, s.length.sides, s.obstacle);
  std::vector<at::Tensor> walls(s.wall_velocity.empty() ? 0 : 2 * box->dim());
  for (const auto& [side, velocity] : s.wall_velocity) {
    TORCH_CHECK_VALUE(side.axis >= 0 && side.axis < box->dim(),
                      "Flow: a side of wall_velocity must have an axis below ", box->dim(), ", got ", side.axis);
    walls[2 * side.axis + (side.end == FlowEnd::kHigh)] = velocity;
  }
  return {std::move(box),   dt,          std::move(nu.tensor), s.force,   s.inflow,
          std::move(walls), s.advection, s.diffusion,          s.pressure};
}

SolveOptions without_log(SolveOptions options) {
  options.adjoint_log = 0;
  return options;
}

}  // namespace

at::Tensor flow_project(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options) {
  equation.check(u);
  CombinedInfo info;
  return project_sum(*equation.box, with_boundary_values(equation.for_state(u), u), /*added=*/{}, /*potential=*/{},
                     without_log(options), info)
      .u;
}

at::Tensor flow_pressure(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options) {
  return flow_next_and_pressure(equation, u, without_log(options)).u.narrow(1, equation.box->dim(), 1);
}

at::Tensor flow_divergence_of_state(const FlowEquation& equation, const at::Tensor& u) {
  equation.check(u);
  return flow_divergence(*equation.box, with_boundary_values(equation.for_state(u), u));
}

Flow::Flow(FlowEquation equation, SolveOptions options)
    : StepperBase("Flow", std::move(options)), equation_(std::move(equation)) {
  options_.adjoint_log = *log_;
  check_flow_options(options_);
  equation_.check();
}

Flow::Flow(std::vector<int64_t> shape, Viscosity nu, double dt, FlowSettings settings, Solver solver, Backward backward)
    : Flow(make_equation(std::move(shape), std::move(nu), dt, std::move(settings)), {std::move(solver), backward}) {}

at::Tensor Flow::operator()(const at::Tensor& u) {
  return reported(u, [&] { return flow_next(equation_, u, options_); });
}

std::pair<at::Tensor, at::Tensor> Flow::step_and_pressure(const at::Tensor& u) {
  const auto both = reported(u, [&] { return flow_next_and_pressure(equation_, u, options_); });
  const int64_t d = equation_.box->dim();
  return {both.narrow(1, 0, d), both.narrow(1, d, 1)};
}

at::Tensor Flow::rollout(const at::Tensor& u, int64_t steps) {
  return reported(u, [&] { return flow_rollout(equation_, u, steps, options_); });
}

at::Tensor Flow::project(const at::Tensor& u) const { return flow_project(equation_, u, options_); }
at::Tensor Flow::pressure(const at::Tensor& u) const { return flow_pressure(equation_, u, options_); }
at::Tensor Flow::divergence(const at::Tensor& u) const { return flow_divergence_of_state(equation_, u); }

}  // namespace prdp
