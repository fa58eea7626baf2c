#include "prdp/steppers/implicit_step.h"

#include "prdp/autograd/detach_failed.h"
#include "prdp/error_text.h"
#include "prdp/solvers/solve.h"
#include "prdp/steppers/rollout_loops.h"

namespace prdp {

ImplicitStep::ImplicitStep(OperatorAt a, RhsAt rhs, SolveOptions options)
    : StepperBase("ImplicitStep", std::move(options)), operator_(std::move(a)), rhs_(std::move(rhs)) {
  TORCH_CHECK_VALUE(operator_, who_, ": needs an operator");
}

ImplicitStep::ImplicitStep(OperatorAt a, RhsAt rhs, Solver solver, Backward backward)
    : ImplicitStep(std::move(a), std::move(rhs), SolveOptions{std::move(solver), backward}) {}

ImplicitStep::ImplicitStep(OperatorSpec a, RhsAt rhs, Solver solver, Backward backward)
    : ImplicitStep([a = std::move(a)](const at::Tensor&) { return a; }, std::move(rhs), std::move(solver), backward) {}

SolveResult ImplicitStep::solve(const at::Tensor& u, int64_t adjoint_log) const {
  TORCH_CHECK_VALUE(u.dim() >= 2, who_, ": u must have shape (batch, ...), got ", u.sizes());
  const bool may_lose = options_.on_failure != OnFailure::kRaise && u.requires_grad();
  if (!may_lose || u.is_cpu()) {
    auto result = solve_from(u, adjoint_log);
    if (!may_lose || !any_nonfinite(result.info.status)) return result;
  }
  // On the CPU not before a sample is refused: gradients that go through a view are summed in another order.
  const auto state = at::alias(u);
  auto result = solve_from(state, adjoint_log);
  block_gradients_of_failed(state, result.info.status, options_.on_failure);
  return result;
}

SolveResult ImplicitStep::solve_from(const at::Tensor& u, int64_t adjoint_log) const {
  const auto a = operator_(u);
  const auto b = rhs(u);
  TORCH_CHECK_VALUE(b.defined(), who_, ": rhs returned an undefined tensor");
  TORCH_CHECK_VALUE(b.sizes() == u.sizes() && b.scalar_type() == u.scalar_type(), who_,
                    ": rhs must return the shape and dtype of the state, ", u.sizes(), " in ",
                    dtype_name(u.scalar_type()), ", got ", b.sizes(), " in ", dtype_name(b.scalar_type()));
  auto options = options_;
  options.adjoint_log = adjoint_log;
  return linear_solve(a, b, options, start_of_step(options, u));
}

at::Tensor ImplicitStep::operator()(const at::Tensor& u) {
  auto next = reported(u, [&] { return solve(u, *log_); });
  if (next.requires_grad()) logs_of_steps_.clear();
  return next;
}

at::Tensor ImplicitStep::rollout(const at::Tensor& u, int64_t steps) {
  std::vector<AdjointLog> logs;
  auto states = reported(u, [&] {
    TORCH_CHECK_VALUE(steps >= 0, "rollout: steps must be >= 0, got ", steps);
    return solve_by_solve(u, steps, 1, [&](const at::Tensor& state, int64_t) {
      logs.push_back(open_adjoint_log());
      return solve(state, *logs.back());
    });
  });
  // A rollout without gradients, such as a validation, leaves the reports of the last backward pass.
  if (states.requires_grad()) logs_of_steps_ = std::move(logs);
  return states;
}

}  // namespace prdp
