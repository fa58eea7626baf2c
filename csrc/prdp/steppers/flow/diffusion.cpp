#include "prdp/steppers/flow/diffusion.h"

#include "prdp/steppers/flow/kernels.h"
#include "prdp/steppers/flow/stencil_of.h"

namespace prdp {

std::vector<OperatorSpec> diffusion_operators(const FlowEquation& e, const at::Tensor& like) {
  const auto& patterns = e.box->fields(like.options()).diffusion;
  const auto made = flow_kernels::can_run(like) ? flow_kernels::diffusion_coefficients(e, like) : at::Tensor();
  std::vector<OperatorSpec> operators;
  for (size_t k = 0; k < patterns.size(); ++k) {
    if (made.defined()) {
      operators.push_back(stencil_of(*e.box, made[static_cast<int64_t>(k)]));
      continue;
    }
    const auto scaled = patterns[k] * (e.nu * e.dt);
    const auto coefficients = at::cat({scaled.narrow(1, 0, 1) + 1.0, scaled.narrow(1, 1, scaled.size(1) - 1)}, 1);
    operators.push_back(stencil_of(*e.box, coefficients));
  }
  return operators;
}

FlowParts diffuse(const FlowEquation& equation, const std::vector<OperatorSpec>& operators, const at::Tensor& change,
                  SolveOptions options, CombinedInfo& info) {
  options.channels_are_components = true;
  const auto width = change.size(1) / static_cast<int64_t>(operators.size());
  FlowParts parts;
  for (size_t k = 0; k < operators.size(); ++k)
    parts.push_back(
        counted_solve(operators[k], change.narrow(1, static_cast<int64_t>(k) * width, width), options, info));
  const auto& free = equation.box->fields(change.options()).free;
  if (flow_kernels::can_run(change)) return parts;
  const auto all = joined(parts);
  return {free.defined() ? all * free : all};  // a preconditioner may leave something on the faces of solids
}

DiffuseVjp diffuse_vjp(const FlowEquation& equation, const std::vector<OperatorSpec>& operators,
                       const at::Tensor& cotangent, const at::Tensor& result, const SolveOptions& options,
                       CombinedInfo& info) {
  const auto& patterns = equation.box->fields(cotangent.options()).diffusion;
  const auto width = cotangent.size(1) / static_cast<int64_t>(patterns.size());
  FlowParts parts;
  at::Tensor nu;
  for (size_t k = 0; k < patterns.size(); ++k) {
    const auto of_system = [&](const at::Tensor& t) {
      return t.defined() ? t.narrow(1, static_cast<int64_t>(k) * width, width) : t;
    };
    const auto found = counted_adjoint_solve(operators[k], of_system(cotangent), of_system(result), options, info);
    parts.push_back(found.b);
    if (!found.coefficients.defined()) continue;
    const auto share = equation.nu_gradient(found.coefficients * patterns[k]) * equation.dt;
    nu = nu.defined() ? nu + share : share;
  }
  if (!flow_kernels::can_run(cotangent)) parts = {joined(parts)};
  return {parts, nu};
}

}  // namespace prdp
