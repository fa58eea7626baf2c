#pragma once
#include <ATen/ATen.h>

#include <vector>

#include "prdp/autograd/solve_vjp.h"
#include "prdp/operators/with_autograd.h"

namespace prdp {

/// Product of the cotangent of u with the derivative of the map (b, tensors of A) → u that a solve ran, as
/// the torch op prdp::unrolled_vjp, which runs the iterations again. Each sample goes its way:
///   its cotangent is not finite, or its gradient would not be   fails in words: NONFINITE_INPUT, OVERFLOW
///   solved to rounding, where iterations are not smooth         the implicit derivative, to rounding too:
///     what its last iterations did, or left out for want of a residual, is no derivative of u
///   else                                                        the derivative of exactly its iterations
/// The report has the adjoint solve's numbers for those of implicit derivative; for the last the solve's own
/// iterations and status, with the residual NaN since no system is solved.
SolveVjp unrolled_vjp(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& a,
                      const SolveOptions& options, at::IntArrayRef needed);

/// The same, recorded by autograd, for second derivatives; it keeps all iterates.
SolveVjp unrolled_vjp_recorded(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& a,
                               const SolveOptions& options, at::IntArrayRef needed);

/// The derivative of the same map along tangents of b and of the tensors of A, one for each 1 in `needed` (b
/// first): as the torch op prdp::unrolled_jvp.
at::Tensor unrolled_jvp(at::TensorList tangents, const Solved& solved, const OperatorSpec& a,
                        const SolveOptions& options, at::IntArrayRef needed);

/// The iterations that are differentiated as they ran: so many of each sample, of some none.
struct UnrolledSolve {
  OperatorSpec a;
  at::Tensor x0;  // undefined: from zero
  Solver solver;
  at::Tensor iterations;         // (batch,)
  int64_t checkpoint_every = 0;  // as SolveOptions has it
};

/// The gradients of b and of each tensor, undefined where `needed` (b first) holds 0 or there is none; and
/// the products with A and Aᵀ that it took, of each sample.
struct UnrolledVjp {
  std::vector<at::Tensor> gradients;
  at::Tensor operator_applications;
};

/// The ways there. By hand-written sweeps in the CPU loops, where `has_sweep`: one sample at a time.
bool has_sweep(const Operator& a, const UnrolledSolve& solve, const at::Tensor& b);
UnrolledVjp sweep_vjp(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                      at::IntArrayRef needed);
/// By autograd, one iteration at a time, in plain tensor operations: everything else.
UnrolledVjp replay_vjp(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                       at::IntArrayRef needed);

}  // namespace prdp
