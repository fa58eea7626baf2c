#pragma once
#include "prdp/autograd/linear_solve.h"

namespace prdp {

/// Returns u with its failed samples as constants: their values stay, and no gradient passes through them. Use it with
/// OnFailure::kZeroGrad if the loss depends on the weights in other ways too, such as by a network after the step.
///
/// Of a solve, u is (batch, …) and status (batch,). Of a rollout, u is (batch, steps + 1, …) and status (batch, steps);
/// there a sample is constant from its first failed step on. Raises ValueError for other shapes.
at::Tensor detach_failed(const at::Tensor& u, const at::Tensor& status);

/// Whether a sample was refused for a NaN or Inf in b or A, as far as the host can tell without waiting for a device.
bool any_nonfinite(const at::Tensor& status);

/// From here on no gradient passes through a state u that A(u) and b(u) were made of, for samples whose solve has none:
/// their zero cotangent times an infinite derivative of A or b would be NaN, which weights are shared by. Nothing with
/// kRaise.
void block_gradients_of_failed(const at::Tensor& u, const at::Tensor& status, OnFailure on_failure);

}  // namespace prdp
