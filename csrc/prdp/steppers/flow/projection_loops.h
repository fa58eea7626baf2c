#pragma once
#include "prdp/steppers/flow/box.h"

namespace prdp {

/// factor · div u, (batch, 1, *shape), by loops on the CPU in place of a dozen tensor operations. Without masks.
at::Tensor divergence_by_loops(const FlowBox& box, const at::Tensor& u, double factor);

/// u + factor · grad p on all faces, or on those that `free`, (1, d, *shape), marks with 1.
at::Tensor add_gradient_by_loops(const FlowBox& box, const at::Tensor& u, const at::Tensor& p, double factor,
                                 const at::Tensor& free);

}  // namespace prdp
