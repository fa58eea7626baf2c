#include "prdp/steppers/flow/diffusion.h"

#include "prdp/operators/sums_in_order.h"
#include "prdp/steppers/flow/stencil_of.h"

namespace prdp {

namespace {

/// I - ν dt Δ from -Δ.
OperatorSpec diffusion_operator(const FlowEquation& e, const at::Tensor& pattern) {
  const auto scaled = pattern * (e.nu * e.dt);
  const auto coefficients = at::cat({scaled.narrow(1, 0, 1) + 1.0, scaled.narrow(1, 1, scaled.size(1) - 1)}, 1);
  return stencil_of(*e.box, coefficients);
}

}  // namespace

OperatorSpec stencil_of(const FlowBox& box, const at::Tensor& coefficients) {
  OperatorSpec spec{"stencil", box.shape(), {}, {coefficients}};
  const int64_t d = box.dim();
  for (int64_t axis = 0; axis < d; ++axis) spec.parameters.push_back(box.boundary(axis) == FlowBoundary::kPeriodic);
  for (int64_t k = 0; k <= 2 * d; ++k)
    for (int64_t axis = 0; axis < d; ++axis)
      spec.parameters.push_back(k > 0 && (k - 1) / 2 == axis ? (k % 2 ? -1.0 : 1.0) : 0.0);
  return spec;
}

at::Tensor diffuse(const FlowEquation& equation, const at::Tensor& change, const SolveOptions& options,
                   CombinedInfo& info) {
  const auto& patterns = equation.box->fields(change.options()).diffusion;
  const auto width = change.size(1) / static_cast<int64_t>(patterns.size());
  std::vector<at::Tensor> parts;
  for (size_t k = 0; k < patterns.size(); ++k) {
    const auto b = change.narrow(1, static_cast<int64_t>(k) * width, width);
    parts.push_back(solve(diffusion_operator(equation, patterns[k]), b, options, info));
  }
  const auto& free = equation.box->fields(change.options()).free;
  const auto all = parts.size() == 1 ? parts[0] : at::cat(parts, 1);
  return free.defined() ? all * free : all;  // a preconditioner may leave something on the faces of solids
}

DiffuseVjp diffuse_vjp(const FlowEquation& equation, const at::Tensor& cotangent, const at::Tensor& result,
                       const SolveOptions& options, CombinedInfo& info) {
  const auto& patterns = equation.box->fields(cotangent.options()).diffusion;
  const auto width = cotangent.size(1) / static_cast<int64_t>(patterns.size());
  std::vector<at::Tensor> parts;
  at::Tensor nu;
  for (size_t k = 0; k < patterns.size(); ++k) {
    const auto of_system = [&](const at::Tensor& t) {
      return t.defined() ? t.narrow(1, static_cast<int64_t>(k) * width, width) : t;
    };
    const auto a = diffusion_operator(equation, patterns[k]);
    const auto found = solve_vjp(a, of_system(cotangent), of_system(result), options, info);
    parts.push_back(found.b);
    if (!found.coefficients.defined()) continue;
    const auto share = total(found.coefficients * patterns[k]) * equation.dt;
    nu = nu.defined() ? nu + share : share;
  }
  return {parts.size() == 1 ? parts[0] : at::cat(parts, 1), nu};
}

}  // namespace prdp
