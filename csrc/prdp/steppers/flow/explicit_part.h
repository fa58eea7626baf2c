#pragma once
#include <optional>

#include "prdp/steppers/flow/kernels.h"
#include "prdp/steppers/flow/limits.h"

namespace prdp {

/// The equation without its boundary values in these samples, as zero times NaN is NaN. A value that all samples share
/// stays: if it is not finite, all are refused anyway.
FlowEquation without_boundary_of(FlowEquation e, const at::Tensor& samples);

/// The state of a step with its boundary values, and the samples that it cannot take.
struct Beginning {
  at::Tensor velocity;
  RefusedSamples refused;                                    // with kernels, only where `host_looks`
  std::optional<flow_kernels::PaddedVelocity> of_kernels{};  // its status names the refused, whose values are zero

  /// Samples that are still to be cleared. Undefined with kernels, which have set their values to zero.
  at::Tensor to_clear() const { return of_kernels ? at::Tensor() : refused.mask; }
  /// 0, or why a sample was refused; undefined: none was.
  at::Tensor status() const;
};
/// `host_looks`: whether `refused` is filled in where kernels run, which waits for the device.
Beginning begin_step(const FlowEquation& e, const at::Tensor& u, bool host_looks);

/// The velocity that the explicit part starts from, and its change by explicit Euler.
struct ExplicitPart {
  at::Tensor velocity, change;
};
ExplicitPart explicit_part(const FlowEquation& e, const Beginning& beginning);
/// The same by tensor operations or loops, from u with its boundary values and the samples that are refused.
ExplicitPart explicit_part_without_kernels(const FlowEquation& e, const at::Tensor& with_boundary,
                                           const at::Tensor& refused);

}  // namespace prdp
