#pragma once
#include "prdp/operators/stencil_operator.h"
#include "prdp/steppers/flow/box.h"

namespace prdp {

/// The operator with these coefficients, (1, 2 d + 1, *shape): of the point itself, and of its neighbours low and high
/// along each axis.
inline OperatorSpec stencil_of(const FlowBox& box, const at::Tensor& coefficients) {
  std::vector<bool> periodic;
  for (int64_t axis = 0; axis < box.dim(); ++axis) periodic.push_back(box.boundary(axis) == FlowBoundary::kPeriodic);
  return nearest_stencil(coefficients, box.shape(), periodic);
}

}  // namespace prdp
