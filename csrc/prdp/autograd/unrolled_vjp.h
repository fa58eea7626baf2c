#pragma once
#include <ATen/ATen.h>

#include <vector>

#include "prdp/operators/operator.h"
#include "prdp/operators/with_autograd.h"
#include "prdp/solvers/solver.h"

namespace prdp {

/// The iterations that a solve ran, as the unrolled mode differentiates them.
struct UnrolledSolve {
  OperatorSpec a;
  Solver solver;
  at::Tensor iterations, status;  // (batch,)
  int64_t checkpoint_every = 0;   // as SolveOptions has it
};

/// Product of the cotangent of u with the derivative of the map (b, tensors of A) → u of exactly the
/// iterations that ran: the gradients of b and of each tensor, undefined where `needed` (b first) holds 0
/// or there is none; and the products with A and Aᵀ that it took, of each sample.
struct UnrolledVjp {
  std::vector<at::Tensor> gradients;
  at::Tensor operator_applications;
};

/// The report of it: the iterations and the status are the solve's, the residual is NaN, since no system
/// is solved.
SolveInfo unrolled_info(const UnrolledVjp& found, const UnrolledSolve& solve, const at::Tensor& b);

/// As the torch op prdp::unrolled_vjp, which runs the iterations again: nothing but b and A is kept for
/// it. `log`: where its report goes (adjoint_log.h).
UnrolledVjp unrolled_vjp(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                         at::IntArrayRef needed, int64_t log);

/// The same, recorded by autograd, for second derivatives; it keeps all iterates.
UnrolledVjp unrolled_vjp_recorded(const at::Tensor& cotangent, const at::Tensor& b,
                                  const UnrolledSolve& solve, at::IntArrayRef needed, int64_t log);

/// The ways of the op. By hand-written sweeps in the CPU loops, where `has_sweep`: one sample at a time.
bool has_sweep(const Operator& a, const UnrolledSolve& solve, const at::Tensor& b);
UnrolledVjp sweep_vjp(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                      at::IntArrayRef needed);
/// By autograd, one iteration at a time, in plain tensor operations: everything else.
UnrolledVjp replay_vjp(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                       at::IntArrayRef needed);

}  // namespace prdp
