#pragma once
#include <ATen/ATen.h>

#include <functional>

#include "prdp/operators/operator.h"
#include "prdp/solvers/solver.h"

namespace prdp {

/// v → M⁻¹ v for vectors (batch, …) in plain tensor operations; differentiable in v any number of times, M being a
/// constant.
using TensorPreconditioner = std::function<at::Tensor(const at::Tensor& v)>;

/// That of the preconditioner of `a` for vectors like b: an operator of the user's own, or V-cycles, by kernels of a
/// GPU or by the loops of the CPU, to which vectors of a device without kernels are copied; empty for none and for the
/// diagonal. Raises ValueError or TypeError unless it takes vectors as b.
TensorPreconditioner make_inverse(const Operator& a, const Preconditioner& preconditioner, const at::Tensor& b);

}  // namespace prdp
