#include "prdp/steppers/stepper.h"

#include "prdp/autograd/adjoint_log.h"

namespace prdp {

Stepper::Stepper(Equation equation, SolveOptions options)
    : equation_(std::move(equation)),
      options_(std::move(options)),
      adjoint_log_(new int64_t(adjoint_log::open()), [](const int64_t* log) {
        adjoint_log::close(*log);
        delete log;
      }) {
  options_.adjoint_log = *adjoint_log_;
  options_.check(equation_.kind.c_str());
  equation_.check();
}

at::Tensor Stepper::operator()(const at::Tensor& u) {
  auto [next, info] = step(equation_, u, options_);
  info_ = std::move(info);
  return next;
}

at::Tensor Stepper::rollout(const at::Tensor& u, int64_t steps) {
  auto [states, info] = prdp::rollout(equation_, u, steps, options_);
  info_ = std::move(info);
  return states;
}

void Stepper::set_max_iter(int64_t k) {
  Solver{options_.solver.method, k}.check(equation_.kind.c_str());
  options_.solver.max_iter = k;
}

std::optional<SolveInfo> Stepper::adjoint_info() const { return adjoint_log::read(*adjoint_log_); }

bool Stepper::converged() const {
  const auto adjoint = adjoint_info();
  return info_ && info_->status.gt(0).all().item<bool>() &&
         (!adjoint || adjoint->status.gt(0).all().item<bool>());
}

Poisson::Poisson(std::vector<int64_t> shape, Solver solver, Backward backward)
    : Stepper({"poisson", std::move(shape), {}, {}}, {std::move(solver), backward}) {}

Heat::Heat(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver, Backward backward)
    : Stepper({"heat", std::move(shape), {dt}, {std::move(nu.tensor)}}, {std::move(solver), backward}) {}

Burgers::Burgers(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver, Backward backward,
                 int64_t picard_steps)
    : Stepper({"burgers", std::move(shape), {dt}, {std::move(nu.tensor)}, picard_steps},
              {std::move(solver), backward}) {}

NavierStokes::NavierStokes(std::vector<int64_t> shape, Viscosity nu, double dt, Solver solver,
                           Backward backward, int64_t picard_steps)
    : Stepper({"navier_stokes", std::move(shape), {dt}, {std::move(nu.tensor)}, picard_steps},
              {std::move(solver), backward}) {}

}  // namespace prdp
