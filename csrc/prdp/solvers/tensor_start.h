#pragma once
#include "prdp/operators/operator.h"
#include "prdp/solvers/solver.h"

namespace prdp {

/// Where the iterations of a batch of tensors start, and whether that took a product. All undefined: at zero.
struct TensorStart {
  at::Tensor x, r;     // r = b - A x
  at::Tensor applied;  // (batch, 1, …)
};

/// Whether the method starts from a given x0.
bool takes_start(Method method, const at::Tensor& x0);
/// As start_from() (start.h); b is scaled and within the range of A. A constant: but autograd stays on, as an operator
/// keeps what it computes first, for later products as well.
TensorStart make_start(const Operator& a, const at::Tensor& b, const at::Tensor& x0);

}  // namespace prdp
