#include "prdp/steppers/flow/step.h"

#include "prdp/operators/tensors.h"
#include "prdp/steppers/flow/balance.h"
#include "prdp/steppers/flow/diffusion.h"
#include "prdp/steppers/flow/explicit_part.h"
#include "prdp/steppers/flow/projection.h"
#include "prdp/steppers/flow/tendency.h"

namespace prdp {

FlowStep flow_step(const FlowEquation& equation, const at::Tensor& u, const SolveOptions& options, bool reported) {
  const auto e = equation.for_state(u);
  const bool host_looks =
      reported && (options.on_failure == OnFailure::kRaise || options.on_failure == OnFailure::kWarn);
  const auto beginning = begin_step(e, u, host_looks);
  const auto& refused = beginning.refused;
  if (reported && refused.mask.defined())
    report_refused(e, with_boundary_values(e, u).detach(), refused, options.on_failure);
  const auto [velocity, change] = explicit_part(e, beginning);
  CombinedInfo info;
  const auto balanced = balance(e, change, options, info);
  const auto diffused = e.is_diffused_implicitly()
                            ? diffuse(e, diffusion_operators(e, change), balanced.u, options, info)
                            : FlowParts{change};
  const auto [next, potential] = project_sum(*e.box, velocity, diffused, balanced.potential, options, info);
  const bool none_refused = host_looks && !refused.mask.defined();
  return {cleared(next, beginning.to_clear()), cleared(potential, beginning.to_clear()),
          info.info(none_refused ? at::Tensor() : beginning.status())};
}

}  // namespace prdp
