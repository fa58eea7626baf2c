#pragma once
#include "prdp/solvers/solver.h"

namespace prdp {

/// The cotangent of a step without the samples that get no gradient.
struct UsableCotangent {
  at::Tensor bar;
  at::Tensor refused{};  // (batch,): those whose cotangent is not finite; undefined: none is

  /// The report of the adjoint solves, and of these samples.
  SolveInfo reported(SolveInfo info) const;
};

/// Leaves out the samples that failed, `status` (batch,) or undefined, where `on_failure` says so, and those whose
/// cotangent is not finite. The latter raise or warn as failed adjoint solves do. Kernels and their solves do all of
/// that themselves, but for the cotangent of a pressure.
UsableCotangent usable_cotangent(const at::Tensor& cotangent, const at::Tensor& status, bool has_pressure,
                                 OnFailure on_failure);

}  // namespace prdp
