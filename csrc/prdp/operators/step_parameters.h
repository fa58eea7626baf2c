#pragma once
#include "prdp/operators/operator.h"

namespace prdp {

/// The sides of the domain: what follows the first `others` parameters; empty where all are 1.
std::vector<double> lengths_of(const OperatorSpec& spec, size_t others);

/// A number of the host.
double number_of(const at::Tensor& t);

/// What every implicit step with diffusion has: its first parameter dt and, last of its tensors, nu.
struct StepParameters {
  /// Raises ValueError unless the first parameter of `spec`, dt, is finite and > 0 and it has as many
  /// tensors as `expected` ("one tensor, nu") says, the last 0-dimensional; TypeError unless that is
  /// real. `owner` names the caller.
  StepParameters(const char* owner, const OperatorSpec& spec, size_t tensors, const char* expected);
  /// Raises ValueError unless nu is finite and >= 0.
  void check_values(Checks checks) const;
  /// nu as a number of the host.
  double nu_value() const { return number_of(nu); }

  const char* owner;
  double dt;
  at::Tensor nu;
};

}  // namespace prdp
