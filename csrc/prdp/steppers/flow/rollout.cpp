#include "prdp/steppers/flow/rollout.h"

#include "prdp/autograd/detach_failed.h"
#include "prdp/autograd/for_each_cotangent.h"
#include "prdp/operators/tensors.h"
#include "prdp/steppers/flow/diffusion.h"
#include "prdp/steppers/flow/step_node.h"
#include "prdp/steppers/rollout_loops.h"

namespace prdp {

namespace {

/// A step whose solves have nodes of their own.
SolveResult unrolled_step(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options,
                          FlowOutput output = FlowOutput::kNext) {
  const auto step = flow_step(equation, u, options);
  const auto out = output_of(step, output, equation.dt);
  return {options.on_failure == OnFailure::kZeroGrad ? detach_failed(out, step.info.status) : out, step.info};
}

SolveResult one_step(const FlowEquation& equation, const at::Tensor& u, FlowOutput output,
                     const SolveOptions& options) {
  if (options.backward != Backward::kUnrolled) return flow_steps(equation, u, 1, output, options);
  check_flow_options(options);
  equation.check_steps(u, 1);
  return unrolled_step(equation, u, options, output);
}

/// Whether the implicit diffusion takes the forces with their pressure, and commutes with the projection after it, in
/// some samples at least: where all faces are free. An incremental step takes the pressure off before, unless they are
/// in all samples.
bool is_diffused_with_pressure(const FlowEquation& e) {
  const auto& fields = e.box->fields(e.nu.options());
  const bool in_some = fields.is_free.defined() && e.pressure == FlowPressure::kPlain;
  return e.is_diffused_implicitly() && (!fields.free.defined() || in_some);
}

SolveResult unrolled_rollout(const FlowEquation& equation, const at::Tensor& u, int64_t steps,
                             const SolveOptions& options) {
  check_flow_options(options);
  equation.check_steps(u, steps);
  return solve_by_solve(u, steps, 1,
                        [&](const at::Tensor& state, int64_t) { return unrolled_step(equation, state, options); });
}

}  // namespace

SolveResult flow_next(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options) {
  return one_step(equation, u, FlowOutput::kNext, options);
}

SolveResult flow_next_and_pressure(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options) {
  auto found = one_step(equation, u, FlowOutput::kNextAndPressure, options);
  if (!is_diffused_with_pressure(equation)) return found;
  const int64_t d = equation.box->dim();
  const auto p = found.u.narrow(1, d, 1);  // φ/Δt of the projection; the pressure is (I - ν Δt L) φ/Δt
  auto diffusion = diffusion_operators(equation.for_state(u), p).front();  // the same for all
  auto& coefficients = diffusion.tensors[0];
  if (options.on_failure != OnFailure::kRaise && coefficients.requires_grad()) {
    // A sample whose cotangent is not finite adds nothing to the gradient of ν.
    auto sizes = coefficients.sizes().vec();
    sizes[0] = u.size(0);
    coefficients = coefficients.expand(sizes);
    coefficients.register_hook([](const at::Tensor& cotangents) {
      return for_each_cotangent(cotangents, [](const at::Tensor& g) {
        return std::vector<at::Tensor>{cleared(g, nonfinite(g).flatten(1).any(1))};
      })[0];
    });
  }
  auto whole = make_operator(diffusion)->apply(p);
  if (const auto& is_free = equation.box->fields(u.options()).is_free; is_free.defined())
    whole = at::where(per_sample(is_free, p), whole, p);
  found.u = at::cat({found.u.narrow(1, 0, d), whole}, 1);
  return found;
}

SolveResult flow_rollout(const FlowEquation& equation, const at::Tensor& u, int64_t steps,
                         const SolveOptions& options) {
  TORCH_CHECK_VALUE(steps >= 0, "rollout: steps must be >= 0, got ", steps);
  if (options.backward == Backward::kUnrolled) return unrolled_rollout(equation, u, steps, options);
  auto found = flow_steps(equation, u, steps, FlowOutput::kStates, options);
  if (options.backward == Backward::kNone) found.u = from_state(u, found.u);
  return found;
}

}  // namespace prdp
