#pragma once
#include "prdp/autograd/solve_vjp.h"

namespace prdp {

/// The tangent of u where A(g) u = b and b or tensors of `a` are dual, as options.backward defines the
/// derivative:
///   implicit: A u̇ = ḃ - Ȧ u, by the same method and budget
///   unrolled: the exact derivative of the iterations that ran; itself without derivatives
/// Differentiable in implicit mode.
at::Tensor solve_jvp(const at::Tensor& b, const Solved& solved, const OperatorSpec& a, const SolveOptions& options);

/// v, a right-hand side of a derivative, without what A cannot reach: no u has a part in a null space that was named,
/// so it has no influence. It may be large beside the rest, and so may what rounding leaves of it: it is taken off
/// twice.
at::Tensor reachable_part(const Operator& a, const at::Tensor& v);

}  // namespace prdp
