#pragma once
#include <ATen/ATen.h>

#include <vector>

#include "prdp/autograd/solve_vjp.h"

namespace prdp {

/// The product of the cotangent of u with the derivative of the map (b, tensors of A) → u that a solve ran. It is the
/// torch op prdp::unrolled_vjp, which runs the iterations again. There are these kinds of samples:
///   its cotangent or its gradient is not finite     fails with NONFINITE_INPUT or OVERFLOW
///   solved to rounding                              gets the implicit derivative, because its last iterations, or
///                                                   those that it no longer needed, say nothing about that of u
///   solved by a method that is no polynomial in A, but b̄ or Ā is too far from the implicit one
///                                                   the same: b excites few eigenvectors, and the derivative of the
///                                                   iterations is one in those directions alone, or rounding; or
///                                                   a recurrence came near a breakdown
///   failed, with on_failure="zero_grad"             get none
///   all others                                      get the derivative of exactly their iterations
/// The report of a sample with the implicit derivative is that of its adjoint solve. For the last kind it has the
/// iterations and the status of the forward solve, and NaN as residual, because no system is solved.
/// What is too far, misleading_derivatives.h says.
SolveVjp unrolled_vjp(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& a,
                      const SolveOptions& options, at::IntArrayRef needed);

/// The same, recorded by autograd, for second derivatives; it keeps all iterates.
SolveVjp unrolled_vjp_recorded(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& a,
                               const SolveOptions& options, at::IntArrayRef needed);

/// The derivative of the same map along tangents of b and of the tensors of A, one for each 1 in `needed` (b
/// first): as the torch op prdp::unrolled_jvp.
at::Tensor unrolled_jvp(at::TensorList tangents, const Solved& solved, const OperatorSpec& a,
                        const SolveOptions& options, at::IntArrayRef needed);

/// The iterations to differentiate: a number for each sample, which may be 0.
struct UnrolledSolve {
  OperatorSpec a;
  at::Tensor x0;  // undefined: from zero
  Solver solver;
  at::Tensor iterations;         // (batch,)
  int64_t checkpoint_every = 0;  // as SolveOptions has it
};

/// The gradients of b and of each tensor, undefined where `needed` (b first) is 0 or there is no derivative; and the
/// number of products with A and Aᵀ for each sample. Where the way there has them, also what each sample adds to the
/// gradient of each tensor of A; empty for samples that did not run.
struct UnrolledVjp {
  std::vector<at::Tensor> gradients;
  at::Tensor operator_applications;
  std::vector<std::vector<at::Tensor>> of_samples{};
};

/// Computes them with a tape of the operations in the CPU loops (tape.h), one iteration of one sample at a time; for
/// operators that have such loops, and methods that run on all of them.
bool can_use_tape(const Operator& a, const UnrolledSolve& solve, const at::Tensor& b);
UnrolledVjp tape_vjp(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                     at::IntArrayRef needed);
/// Computes them by autograd, one iteration at a time, in plain tensor operations; for everything else.
UnrolledVjp replay_vjp(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                       at::IntArrayRef needed);

}  // namespace prdp
