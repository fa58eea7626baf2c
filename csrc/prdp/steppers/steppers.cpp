#include "prdp/steppers/steppers.h"

#include <c10/core/InferenceMode.h>

#include <algorithm>

#include "prdp/operators/kinds.h"

namespace prdp {

namespace {

/// The parameters of an equation: those before the lengths, and a length per axis unless all are 1.
std::vector<double> parameters(std::vector<double> first, const Length& length, size_t axes) {
  auto sides = length.sides;
  if (sides.size() == 1) sides.resize(axes, sides[0]);
  if (std::any_of(sides.begin(), sides.end(), [](double side) { return side != 1.0; }))
    first.insert(first.end(), sides.begin(), sides.end());
  return first;
}

/// Outside of inference mode: a tensor made in it could be kept for no gradient.
at::Tensor number(double value) {
  const c10::InferenceMode ended(false);
  return at::scalar_tensor(value, at::kDouble);
}

}  // namespace

Viscosity::Viscosity(double nu) : tensor(number(nu)) {}

Stepper::Stepper(Equation equation, SolveOptions options)
    : StepperBase(operator_kind(equation.kind).title, std::move(options)), equation_(std::move(equation)) {
  options_.adjoint_log = *log_;
  equation_.check();
}

at::Tensor Stepper::operator()(const at::Tensor& u) {
  return reported(u, [&] { return step(equation_, u, options_); });
}

at::Tensor Stepper::rollout(const at::Tensor& u, int64_t steps) {
  return reported(u, [&] { return prdp::rollout(equation_, u, steps, options_); });
}

Poisson::Poisson(std::vector<int64_t> shape, Solver solver, Backward backward, Length length)
    : Stepper({"poisson", shape, parameters({}, length, shape.size()), {}}, {std::move(solver), backward}) {}

Heat::Heat(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver, Backward backward, Length length)
    : Stepper({"heat", shape, parameters({dt}, length, shape.size()), {std::move(nu.tensor)}},
              {std::move(solver), backward}) {}

Burgers::Burgers(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver, Backward backward,
                 int64_t picard_steps, Length length)
    : Stepper({"burgers", shape, parameters({dt}, length, shape.size()), {std::move(nu.tensor)}, picard_steps},
              {std::move(solver), backward}) {}

NavierStokes::NavierStokes(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver, Backward backward,
                           int64_t picard_steps, Length length)
    : Stepper({"navier_stokes", shape, parameters({dt}, length, shape.size()), {std::move(nu.tensor)}, picard_steps},
              {std::move(solver), backward}) {}

}  // namespace prdp
