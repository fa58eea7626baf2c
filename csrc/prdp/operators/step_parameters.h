#pragma once
#include "prdp/operators/operator.h"

namespace prdp {

/// What every implicit step with diffusion has: its parameter dt and, last of its tensors, nu.
struct StepParameters {
  /// Raises ValueError unless `spec` has one parameter, dt, finite and > 0, and as many tensors as
  /// `expected` ("one tensor, nu") says, the last 0-dimensional; TypeError unless that is real.
  /// `owner` names the caller.
  StepParameters(const char* owner, const OperatorSpec& spec, size_t tensors, const char* expected);
  /// Raises ValueError unless nu is finite and >= 0.
  void check_values() const;

  const char* owner;
  double dt;
  at::Tensor nu;
};

}  // namespace prdp
