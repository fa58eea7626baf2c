#pragma once
#include "prdp/operators/operator.h"
#include "prdp/solvers/solve.h"
#include "prdp/solvers/solver.h"

namespace prdp {

/// Solves A(g) u = b and differentiates it: the one entry for steppers and users, in both languages.
/// It calls the torch op prdp::linear_solve, so that autograd, torch.compile and fake tensors follow.
///
/// b: (batch, channel, *shape) for stencils, (n,) or (batch, n) for matrices; u has b's shape.
/// Gradients reach b and the tensors of `a` as options.backward says (paper, section 2.1):
///   implicit: Aᵀ λ = ū by the same method and budget; b̄ = λ, ḡ = -λᵀ ∂(A(g) u)/∂g
///   unrolled: the exact derivative of the iterations that each sample really took
///   none:     none
/// `x0`, of b's shape and dtype, is where the iterations start, and a constant of the derivatives. They start from
/// α x0 with α = ⟨b, A x0⟩ / ⟨A x0, A x0⟩ per sample, which is never worse than zero; that takes one product. The
/// tolerance stays relative to ‖b‖. Direct ignores x0, and so does the adjoint solve.
/// Raises ValueError or TypeError for bad arguments before any work, and torch.linalg.LinAlgError
/// for failed samples unless options.on_failure says otherwise.
SolveResult linear_solve(const OperatorSpec& a, const at::Tensor& b, const SolveOptions& options,
                         const at::Tensor& x0 = {});

/// The same below autograd and the dispatcher, for the kernels of ops: solves, logs and reports.
SolveResult linear_solve_kernel(const OperatorSpec& a, const at::Tensor& b, const SolveOptions& options,
                                const at::Tensor& x0 = {});

/// A matrix (n, n) or (batch, n, n), dense or sparse CSR, as an operator.
OperatorSpec matrix(const at::Tensor& values);

}  // namespace prdp
