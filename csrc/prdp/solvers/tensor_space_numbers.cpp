#include "prdp/operators/tensors.h"
#include "prdp/solvers/batch_loops.h"
#include "prdp/solvers/tensor_space.h"

/// Numbers, one per sample.
namespace prdp {

at::Tensor TensorSpace::rounding_of(const Scalar& v2, const Scalar& w2) const {
  return limits_of(b_).epsilon * v2.detach().sqrt() * w2.detach().sqrt();
}

TensorSpace::Scalar TensorSpace::guarded_quotient(const Scalar& num, const Scalar& den, const Scalar& v2,
                                                  const Scalar& w2) {
  if (in_loops_) {
    const auto [value, breaks] = batch_loops::guarded_quotient(num, den, v2, w2);
    if (breaks.defined()) note_broken(breaks);
    return value;
  }
  // The rules of SampleNumbers; the inner where keeps 0/0 out of the derivative.
  const auto nothing_left = num.detach() < negligible_;
  const auto divisor = at::add(den, w2.detach(), 0.0);  // NaN where w2 is not finite: then nothing is known
  // v2 may overflow for a long direction of M⁻¹; then only den = 0 is a breakdown.
  const auto bound = rounding_of(v2, w2).nan_to_num(0.0, 0.0, 0.0);
  const auto breaks = divisor.detach().abs().le(bound).logical_and(nothing_left.logical_not());
  note_broken(breaks);
  const auto none = nothing_left.logical_or(breaks);
  return at::where(none, at::zeros_like(num), num / at::where(none, at::ones_like(den), divisor));
}

TensorSpace::Scalar TensorSpace::breaks_down(const Scalar& den, const Scalar& v2, const Scalar& w2,
                                             const Scalar& active) const {
  if (in_loops_) return batch_loops::breaks_down(den, v2, w2, active);
  const auto bound = rounding_of(v2, w2);
  const auto breaks = den.detach().abs().le(bound).logical_and(bound.isfinite());
  return breaks.logical_and(active.detach().ne(0)).to(b_.scalar_type());
}

TensorSpace::Scalar TensorSpace::ratio(const Scalar& num, const Scalar& den) {
  if (in_loops_) return batch_loops::ratio(num, den);
  const auto none = den.detach() < negligible_;
  return at::where(none, at::zeros_like(num), num / at::where(none, at::ones_like(den), den));
}

}  // namespace prdp
