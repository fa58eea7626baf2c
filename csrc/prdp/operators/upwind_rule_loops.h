#pragma once
#include "prdp/operators/upwind_rule_kernel.h"

namespace prdp {

/// The product rules of upwind_rule_kernel.h by loops on the CPU, for plain tensors where autograd does not record;
/// nothing elsewhere. They round as the
/// tensor operations of AdvectionDiffusion do, but where samples share winds.
std::optional<UpwindGradients> burgers_rule_on_loops(const Grid& grid, const at::Tensor& winds, double beta,
                                                     const at::Tensor& lambda, const at::Tensor& u);
std::optional<UpwindGradients> navier_stokes_rule_on_loops(const Grid& grid, const at::Tensor& winds,
                                                           const at::Tensor& lambda, const at::Tensor& u);

}  // namespace prdp
