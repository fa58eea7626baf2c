#pragma once
#include "prdp/operators/operator.h"
#include "prdp/solvers/solve.h"
#include "prdp/solvers/solver.h"

namespace prdp {

/// Solves A(g) u = b, with gradients for b and for the tensors g of `a`. Steppers and both languages use this function.
/// It calls the torch op prdp::linear_solve, so it works under autograd, torch.compile and with fake tensors.
///
/// b: (batch, channel, *shape) for operators on grids, (n,) or (batch, n) for matrices; u has the shape of b.
/// options.backward chooses how gradients are computed (paper, section 2.1):
///   kImplicit: Aᵀ λ = ū by the same method and budget; b̄ = λ, ḡ = -λᵀ ∂(A(g) u)/∂g
///   kUnrolled: the exact derivative of the iterations that each sample took
///   kNone:     no gradient
/// `x0`, with the shape and dtype of b, is a guess of u. Each sample starts from α x0, where
/// α = ⟨b, A x0⟩ / ⟨A x0, A x0⟩ minimises the residual; this costs one product. The tolerance stays relative to ‖b‖.
/// x0 gets no gradient. Direct and the adjoint solve ignore it.
/// Raises c10::ValueError or c10::TypeError for bad arguments before any work, and c10::LinAlgError for failed samples
/// unless options.on_failure says otherwise.
SolveResult linear_solve(const OperatorSpec& a, const at::Tensor& b, const SolveOptions& options,
                         const at::Tensor& x0 = {});

/// The same without autograd and the dispatcher, for the kernels of torch ops. It solves, logs and reports failures.
SolveResult linear_solve_unrecorded(const OperatorSpec& a, const at::Tensor& b, const SolveOptions& options,
                                    const at::Tensor& x0 = {});

/// A matrix (n, n) or (batch, n, n), dense or sparse CSR, as an operator. Raises ValueError for other shapes. A sparse
/// tensor gets a gradient where it is a leaf: LibTorch makes it of values without recording that.
OperatorSpec matrix(const at::Tensor& values);

/// A sparse matrix by its compressed rows, whose values get a gradient. crow: (n + 1,), where each row starts; col:
/// (nnz,), the column of each entry; both int32 or int64. values: (nnz,), or (batch, nnz) for a matrix per sample.
/// Raises ValueError or TypeError where these do not fit together.
OperatorSpec csr_matrix(const at::Tensor& crow, const at::Tensor& col, const at::Tensor& values);

}  // namespace prdp
