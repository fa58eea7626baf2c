#pragma once
#include "prdp/steppers/flow/box.h"

namespace prdp {

/// The fields of a box, in float64 on the CPU. Raises ValueError if an obstacle leaves no fluid, or keeps fluid that
/// comes in from going out.
FlowFields make_flow_fields(const FlowBox& box);

}  // namespace prdp
