#include "prdp/steppers/equation_kinds.h"

#include "prdp/grid/grid.h"
#include "prdp/operators/kinds.h"

namespace prdp {

namespace {

/// Δu = -p, and its transpose.
at::Tensor negative(const Equation&, const at::Tensor& u) { return -u; }

/// The velocity over dt, and no source of mass. The map is its own transpose.
at::Tensor velocity_over_dt(const Equation& equation, const at::Tensor& u) {
  return at::cat({u.narrow(1, 0, 2) / equation.parameters[0], at::zeros_like(u.narrow(1, 2, 1))}, 1);
}

at::Tensor flow_rhs(const Equation& equation, const at::Tensor& u) {
  Grid("NavierStokes", equation.shape, Boundary::kPeriodic).check_field(u, 3);
  return velocity_over_dt(equation, u);
}

const std::vector<EquationKind> kKinds{
    {"poisson", /*periodic=*/false, /*channels=*/1, /*linearised=*/false, negative, negative},
    {"heat", false, 1, false},  // b is the state
    {"burgers", true, kPerAxis, true},
    {"navier_stokes", true, 3, true, flow_rhs, velocity_over_dt},
};

}  // namespace

const EquationKind& equation_kind(const std::string& kind) { return row_of(kKinds, "equation", kind); }

}  // namespace prdp
