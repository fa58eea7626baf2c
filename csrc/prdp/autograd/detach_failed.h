#pragma once
#include <ATen/ATen.h>

namespace prdp {

/// Returns u with its failed samples as constants: their values stay, and no gradient passes through them. Use it with
/// OnFailure::kZeroGrad if the loss depends on the weights in other ways too, such as by a network after the step.
///
/// Of a solve, u is (batch, …) and status (batch,). Of a rollout, u is (batch, steps + 1, …) and status (batch, steps);
/// there a sample is constant from its first failed step on. Raises ValueError for other shapes.
at::Tensor detach_failed(const at::Tensor& u, const at::Tensor& status);

}  // namespace prdp
