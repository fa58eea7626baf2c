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
  make_operator(equation_operator(equation_, {}))->check_parameters();
}

at::Tensor Stepper::operator()(const at::Tensor& u) {
  auto [next, info] = step(equation_, u, options_);
  info_ = std::move(info);
  return next;
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

Heat::Heat(std::vector<int64_t> shape, double nu, double dt, Solver solver, Backward backward)
    : Heat(std::move(shape), at::scalar_tensor(nu, at::kDouble), dt, std::move(solver), backward) {}

Heat::Heat(std::vector<int64_t> shape, at::Tensor nu, double dt, Solver solver, Backward backward)
    : Stepper({"heat", std::move(shape), {dt}, {std::move(nu)}}, {std::move(solver), backward}) {}

}  // namespace prdp
