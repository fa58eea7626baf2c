#pragma once
#include "prdp/operators/operator.h"

namespace prdp {

/// A v, or Aᵀ v, without derivative: by the CPU loops of the operator, if it has some, which is several times faster
/// than plain tensor operations.
at::Tensor apply_on_loops(const Operator& a, const at::Tensor& v, bool transposed);

}  // namespace prdp
