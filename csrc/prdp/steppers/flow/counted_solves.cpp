#include "prdp/steppers/flow/counted_solves.h"

#include <limits>

#include "prdp/operators/plain_tensors.h"
#include "prdp/steppers/flow/kernels.h"

namespace prdp {

namespace {

void add_to_report(SolveInfo& all, const SolveInfo& info) {
  const auto solved = all.solved().logical_and(info.solved());
  all.iterations = all.iterations + info.iterations;
  all.residual = at::maximum(all.residual, info.residual);
  all.status = at::minimum(all.status, info.status);  // the least is the worst
  all.operator_applications = all.operator_applications + info.operator_applications;
  all.floor = at::maximum(all.floor, info.floor) * solved;
}

}  // namespace

SolveInfo CombinedInfo::info(const at::Tensor& refused) const {
  if (infos_.empty() || (infos_.size() == 1 && !refused.defined())) return infos_.empty() ? SolveInfo{} : infos_[0];
  if (auto joined = flow_kernels::joined_reports(infos_, refused)) return *std::move(joined);
  auto all = infos_[0];
  for (size_t k = 1; k < infos_.size(); ++k) add_to_report(all, infos_[k]);
  if (!refused.defined()) return all;
  const auto fine = refused.eq(0);
  all.status = at::where(fine, all.status, refused);
  all.residual = all.residual.masked_fill(fine.logical_not(), std::numeric_limits<double>::infinity());
  return all;
}

at::Tensor counted_solve(const OperatorSpec& a, const at::Tensor& b, const SolveOptions& options, CombinedInfo& info) {
  // Within a node of autograd there is nothing to record, and what is kept between solves does not cross a dispatcher.
  const bool at_once = !at::GradMode::is_enabled() && is_plain(b) && all_plain(a.tensors) && !has_tangent(b) &&
                       all_plain(options.solver.preconditioner.spec().tensors);
  auto result = (at_once ? linear_solve_unrecorded : linear_solve)(a, b, options, /*x0=*/{});
  info.add(result.info);
  return result.u;
}

SystemVjp counted_adjoint_solve(const OperatorSpec& a, const at::Tensor& cotangent, const at::Tensor& u,
                                const SolveOptions& options, CombinedInfo& info) {
  std::vector<int64_t> needed(a.tensors.size() + 1, 0);
  needed[0] = 1;
  needed[1] = u.defined();
  const auto found = implicit_vjp(cotangent, u, a, options, needed, linear_solve_unrecorded);
  info.add(found.info);
  return {found.gradients[0], found.gradients[1]};
}

}  // namespace prdp
