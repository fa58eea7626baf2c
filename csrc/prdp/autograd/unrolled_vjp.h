#pragma once
#include <ATen/ATen.h>

#include <vector>

#include "prdp/autograd/solve_vjp.h"

namespace prdp {

/// The product of the cotangent of u with the derivative of the map (b, tensors of A) → u that a solve ran. It is the
/// torch op prdp::unrolled_vjp, which runs the iterations again. What a sample gets:
///   its cotangent or its gradient is not finite   zeros; it fails with NONFINITE_INPUT or OVERFLOW
///   it is solved to rounding                      the implicit derivative, as its last iterations are rounding
///   its b̄ or Ā is far from the implicit one       the implicit derivative (misleading_derivatives.h says what is far)
///   it overflowed, or failed with NaN in M⁻¹ or   none
///   with on_failure="zero_grad"
///   else                                          the derivative of exactly its iterations
/// The report of a sample with the implicit derivative is that of its adjoint solve. Of the last kind it has the
/// iterations and the status of the forward solve, and NaN as residual, because no system is solved.
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
/// number of products with A and Aᵀ for each sample. From tape_vjp() also what each sample adds to the gradient of each
/// tensor of A, empty for samples that added nothing; but not where the method divides by the diagonal.
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
