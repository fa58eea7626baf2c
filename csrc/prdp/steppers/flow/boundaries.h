#pragma once
#include "prdp/steppers/flow/box.h"

namespace prdp {

/// The fields of a box, in float64 on the CPU. Raises ValueError if an obstacle leaves no fluid, or keeps fluid that
/// comes in from going out.
FlowFields make_flow_fields(const FlowBox& box);

/// Raises ValueError or TypeError unless it is bool (*shape) or (samples, *shape).
void check_obstacle(const at::Tensor& obstacle, at::IntArrayRef shape);

/// `obstacle`, bool (*shape) or (batch, *shape), and what nothing flows through: all fluid but the largest connected
/// part or, in a box with an open axis, the parts that join its two ends. `box` has no obstacle. Raises ValueError if
/// no fluid is left.
at::Tensor fill_pockets(const FlowBox& box, const at::Tensor& obstacle);

}  // namespace prdp
