#pragma once
#include "prdp/autograd/finite_rows.h"
#include "prdp/autograd/unrolled_vjp.h"

/// When the derivative of a solve's iterations tells nothing about that of its solution, though the solve is done:
/// iterations excite few eigenvectors, so that b̄ may be far from the solution's, and Ā may be amplified rounding.
/// Both are compared with what the implicit derivative must fulfil. Polynomials in A cannot mislead.
namespace prdp {

/// Whether the derivatives of this method's iterations may mislead.
bool may_mislead(const Solver& solver);

/// The samples whose solve is done by what it left: those that met their tolerance or stagnated, or whose last
/// iteration left no more than √ε ‖b‖. Without an iteration there is nothing to mislead: the derivative is zero.
Rows solved_samples(const Solved& solved);

/// How far b̄ and Ā of each sample may be from the implicit ones, relative to these.
std::vector<double> allowed_disagreement(const Solved& solved, const Solver& solver);

/// Those of `rows` whose b̄ leaves more of the adjoint system Aᵀ b̄ = ū than allowed.
Rows misleading_b_bar(const Operator& a, const at::Tensor& cotangent, const at::Tensor& b_bar, const Rows& rows,
                      const std::vector<double>& allowed);

/// Those of `rows` whose Ā differs from -∂⟨b̄, A u⟩/∂A, the solution's, by more than allowed. `gradients` (b first) are
/// sums over `rows` alone. Samples that share a tensor of A are looked at together, as it has the sum of their
/// gradients: give one to judge it alone.
Rows misleading_a_bar(const OperatorSpec& spec, const std::vector<at::Tensor>& gradients, const at::Tensor& u,
                      at::IntArrayRef needed, const Rows& rows, const std::vector<double>& allowed);

}  // namespace prdp
