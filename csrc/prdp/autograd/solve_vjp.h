#pragma once
#include "prdp/autograd/linear_solve.h"

namespace prdp {

/// What a solve A u = b stores for its derivative. Implicit mode needs u if A has a derivative. Unrolled mode needs all
/// the other tensors. Both need the status if failed samples do not raise an error.
struct Solved {
  at::Tensor b, u, iterations, status, residual;
  at::Tensor x0{};  // undefined: from zero
};

/// The product of the cotangent ū with the derivative of (b, tensors of A) → u, as options.backward
/// defines it: gradients of b and of each tensor of `a`, undefined where `needed` (b first) holds 0 or
/// there is none; and the report of the adjoint solve. Where autograd records, it is differentiable, if
/// `adjoint_solve` is.
struct SolveVjp {
  std::vector<at::Tensor> gradients;
  SolveInfo info;
};
SolveVjp solve_vjp(at::Tensor cotangent, const Solved& solved, const OperatorSpec& a, const SolveOptions& options,
                   at::IntArrayRef needed, decltype(linear_solve)& adjoint_solve = linear_solve);

/// A cotangent or tangent with zeros for the samples that carry none: the refused ones, whose u is the constant
/// zero, and with kZeroGrad all that failed. With kRaise there are no such samples.
at::Tensor without_failed(const at::Tensor& derivative, const at::Tensor& status, OnFailure on_failure);
/// The implicit one: Aᵀ λ = ū; b̄ = λ; ḡ = -∂⟨λ, A(g) u⟩/∂g. Without u, b̄ alone. A sample whose share of ḡ
/// leaves the range of the dtype fails: OVERFLOW, and zeros.
SolveVjp implicit_vjp(const at::Tensor& cotangent, const at::Tensor& u, const OperatorSpec& a,
                      const SolveOptions& options, at::IntArrayRef needed, decltype(linear_solve)& adjoint_solve);

}  // namespace prdp
