#include "prdp/steppers/flow/solves.h"

namespace prdp {

void CombinedInfo::add(const SolveInfo& info) {
  if (!info_.status.defined()) {
    info_ = info;
    return;
  }
  const auto solved = info_.solved().logical_and(info.solved());
  info_.iterations = info_.iterations + info.iterations;
  info_.residual = at::maximum(info_.residual, info.residual);
  info_.status = at::minimum(info_.status, info.status);  // the least is the worst
  info_.operator_applications = info_.operator_applications + info.operator_applications;
  info_.floor = at::maximum(info_.floor, info.floor) * solved;
}

at::Tensor solve(const OperatorSpec& a, const at::Tensor& b, const SolveOptions& options, CombinedInfo& info) {
  auto result = linear_solve(a, b, options);
  info.add(result.info);
  return result.u;
}

SystemVjp solve_vjp(const OperatorSpec& a, const at::Tensor& cotangent, const at::Tensor& u,
                    const SolveOptions& options, CombinedInfo& info) {
  std::vector<int64_t> needed(a.tensors.size() + 1, 0);
  needed[0] = 1;
  needed[1] = u.defined();
  const auto found = implicit_vjp(cotangent, u, a, options, needed, linear_solve_kernel);
  info.add(found.info);
  return {found.gradients[0], found.gradients[1]};
}

}  // namespace prdp
