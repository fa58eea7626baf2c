#pragma once
#include "prdp/operators/operator.h"

namespace prdp {

/// Warns of a tensor of a Function that requires grad and changes its product, but that no derivative of the product
/// leads back to, such as one by which the product takes a derivative without recording it: it would have no gradient,
/// in silence. Looks in the 1st, 2nd, 4th, 8th, … solve that is recorded, once it has succeeded.
void warn_of_unreached_tensors(const OperatorSpec& a, const at::Tensor& b);

}  // namespace prdp
