#pragma once
#include <ATen/ATen.h>

#include <vector>

#include "prdp/operators/operator.h"
#include "prdp/solvers/solver.h"

namespace prdp {

/// The iterations that a solve ran, as the unrolled mode differentiates them.
struct UnrolledSolve {
  OperatorSpec a;
  Solver solver;
  at::Tensor iterations, status;  // (batch,)
};

/// Product of the cotangent of u with the derivative of the map (b, tensors of A) → u of exactly the
/// iterations that ran; one tensor for each input that `needed` (b first) marks with 1. As the torch op
/// prdp::unrolled_vjp, which recomputes the iterations: nothing but b and A is kept for it.
std::vector<at::Tensor> unrolled_vjp(const at::Tensor& cotangent, const at::Tensor& b,
                                     const UnrolledSolve& solve, at::IntArrayRef needed);

/// The same, recorded by autograd, for second derivatives.
std::vector<at::Tensor> unrolled_vjp_recorded(const at::Tensor& cotangent, const at::Tensor& b,
                                              const UnrolledSolve& solve,
                                              at::IntArrayRef needed);

}  // namespace prdp
