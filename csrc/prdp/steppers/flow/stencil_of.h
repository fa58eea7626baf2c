#pragma once
#include "prdp/operators/operator.h"
#include "prdp/steppers/flow/box.h"

namespace prdp {

/// The operator with these coefficients, (1, 2 d + 1, *shape): of the point itself, and of its neighbours low and high
/// along each axis.
OperatorSpec stencil_of(const FlowBox& box, const at::Tensor& coefficients);

}  // namespace prdp
