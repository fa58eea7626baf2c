#pragma once
#include "prdp/autograd/solve_vjp.h"

namespace prdp {

/// The tangent of u where A(g) u = b and b or tensors of `a` are dual, as options.backward defines the
/// derivative:
///   implicit: A u̇ = ḃ - Ȧ u, by the same method and budget
///   unrolled: the exact derivative of the iterations that ran; itself without derivatives
/// Differentiable in implicit mode.
at::Tensor solve_jvp(const at::Tensor& b, const Solved& solved, const OperatorSpec& a, const SolveOptions& options);

}  // namespace prdp
