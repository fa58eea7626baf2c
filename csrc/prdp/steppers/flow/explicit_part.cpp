#include "prdp/steppers/flow/explicit_part.h"

#include "prdp/operators/tensors.h"
#include "prdp/steppers/flow/explicit_loops.h"
#include "prdp/steppers/flow/tendency.h"

namespace prdp {

FlowEquation without_boundary_of(FlowEquation e, const at::Tensor& samples) {
  if (!samples.defined()) return e;
  const auto clear = [&](at::Tensor& t) {
    if (t.defined() && t.dim() > 1 && t.size(0) == samples.size(0)) t = cleared(t, samples);
  };
  clear(e.inflow);
  for (auto& velocity : e.wall_velocity) clear(velocity);
  return e;
}

at::Tensor Beginning::status() const {
  if (of_kernels) return of_kernels->status;
  return refused.mask.defined() ? refused.status * refused.mask : at::Tensor();
}

Beginning begin_step(const FlowEquation& e, const at::Tensor& u, bool host_looks) {
  if (auto start = flow_kernels::pad_velocity(e, u))
    return {start->velocity, host_looks ? refused_by(start->status) : RefusedSamples{}, start};
  const auto velocity = with_boundary_values(e, u);
  return {velocity, find_refused(e, velocity.detach())};
}

ExplicitPart explicit_part(const FlowEquation& e, const Beginning& beginning) {
  if (!beginning.of_kernels) return explicit_part_without_kernels(e, beginning.velocity, beginning.refused.mask);
  const auto change = flow_kernels::change(e, *beginning.of_kernels);
  if (change.defined()) return {beginning.velocity, change};
  return explicit_part_without_kernels(e, beginning.velocity, beginning.of_kernels->status.ne(0));
}

ExplicitPart explicit_part_without_kernels(const FlowEquation& e, const at::Tensor& with_boundary,
                                           const at::Tensor& refused) {
  const auto velocity = cleared(with_boundary, refused);
  const auto change = cleared(tendency(without_boundary_of(e, refused), velocity), refused);
  // Where autograd may record, a tensor stays as it is.
  return {velocity, flow_has_loops(velocity) ? change.mul_(e.dt) : change * e.dt};
}

}  // namespace prdp
