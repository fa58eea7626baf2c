#include "prdp/autograd/solve_jvp.h"

#include "prdp/autograd/unrolled_vjp.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"

namespace prdp {

at::Tensor reachable_part(const Operator& a, const at::Tensor& v) {
  const auto part = a.project(a.project(v));
  if (!a.needs_projection()) return part;
  const double rounding = 4.0 * epsilon_of(v);  // of every entry: all that is left of the cotangent of a sum, say
  const auto size = v.detach().abs().flatten(1), left = part.detach().abs().flatten(1);
  return cleared(part, (left <= rounding * size).all(1) & size.any(1));  // a zero keeps its derivative
}

namespace {

OperatorSpec without_tangents(OperatorSpec a) {
  for (auto& t : a.tensors) t = primal(t);
  return a;
}

/// ḃ - Ȧ u
at::Tensor tangent_rhs(const at::Tensor& b, const at::Tensor& u, const OperatorSpec& a) {
  auto rhs = b._fw_grad(/*level=*/0);
  if (any_tangent(a.tensors)) {
    const auto product = make_operator(a)->apply(u);
    if (has_tangent(product)) add_to(rhs, product._fw_grad(/*level=*/0).neg());
  }
  return rhs.defined() ? rhs : at::zeros_like(u);
}

at::Tensor implicit(const at::Tensor& b, const Solved& solved, const OperatorSpec& a, SolveOptions options) {
  const auto spec = without_tangents(a);
  auto rhs = tangent_rhs(b, solved.u, a);
  rhs = without_failed(rhs, solved.status, options.on_failure);
  options.adjoint_log = 0;  // it is the primal solve's
  const auto tangent = linear_solve(spec, reachable_part(*make_operator(spec), rhs), options);
  return options.on_failure == OnFailure::kZeroGrad ? without_failed(tangent.u, tangent.info.status, options.on_failure)
                                                    : tangent.u;
}

at::Tensor unrolled(const at::Tensor& b, const Solved& solved, const OperatorSpec& a, const SolveOptions& options) {
  std::vector<at::Tensor> tangents;
  std::vector<int64_t> needed;
  const auto take = [&](const at::Tensor& t) {
    needed.push_back(has_tangent(t));
    if (has_tangent(t)) tangents.push_back(t._fw_grad(/*level=*/0));
  };
  take(b);
  for (const auto& t : a.tensors) take(t);
  auto plain = solved;
  plain.b = primal(b);
  return without_failed(unrolled_jvp(tangents, plain, without_tangents(a), options, needed), solved.status,
                        options.on_failure);
}

}  // namespace

at::Tensor solve_jvp(const at::Tensor& b, const Solved& solved, const OperatorSpec& a, const SolveOptions& options) {
  return options.backward == Backward::kUnrolled ? unrolled(b, solved, a, options) : implicit(b, solved, a, options);
}

}  // namespace prdp
