#pragma once
#include <ATen/ATen.h>

namespace prdp {

/// u with its failed samples as constants: their values stay, and no gradient passes through them. For a loss that
/// is made of u by more ways than the solve (a network on top of a step), with on_failure = zero_grad.
///
/// u: (batch, …) and status: (batch,) of a solve; or the states (batch, steps + 1, …) and the status (batch, steps)
/// of a rollout, where a sample is constant from the step on that failed. Raises ValueError for other shapes.
at::Tensor detach_failed(const at::Tensor& u, const at::Tensor& status);

}  // namespace prdp
