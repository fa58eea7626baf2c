#pragma once
#include "prdp/operators/operator.h"

namespace prdp {

/// The sides of the domain: what follows the first `others` parameters; empty where all are 1.
std::vector<double> lengths_of(const OperatorSpec& spec, size_t others);

/// A number of the host.
double number_of(const at::Tensor& t);

/// What every implicit step with diffusion has: its first parameter dt and, last of its tensors, nu, a number for all
/// samples, (), or (batch or 1,).
struct StepParameters {
  /// Raises ValueError unless the first parameter of `spec`, dt, is finite and > 0 and it has as many
  /// tensors as `expected` ("one tensor, nu") says, the last with at most one axis; TypeError unless that is
  /// real. `owner` names the caller.
  StepParameters(const char* owner, const OperatorSpec& spec, size_t tensors, const char* expected);
  /// Raises ValueError or TypeError unless a nu with an axis goes with the vector b.
  void check_vector(const at::Tensor& b) const;
  /// Raises ValueError unless nu is finite and >= 0.
  void check_values(Checks checks) const;
  /// Why a sample is refused, as Operator::refusal().
  std::string refusal(int64_t sample) const;

  /// Whether samples may differ in nu.
  bool has_axis() const { return nu.dim() == 1; }
  /// nu as numbers of the host: one, or one for each sample. NaN where it is not allowed and has_axis().
  std::vector<double> nu_values() const;
  /// nu beside fields (batch, channel, *shape) with so many axes in shape.
  at::Tensor nu_beside(int64_t axes) const;
  /// Of the samples `index`.
  at::Tensor nu_of(const at::Tensor& index) const;
  /// The gradient of nu from terms (batch, …), which it sums.
  at::Tensor gradient(const at::Tensor& terms) const;

  const char* owner;
  double dt;
  at::Tensor nu;
};

}  // namespace prdp
