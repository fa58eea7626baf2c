#pragma once
#include "prdp/autograd/solve_vjp.h"
#include "prdp/operators/registered_products.h"

namespace prdp {

/// What a solve A u = b with a Function keeps for a look at b̄. In implicit mode that is λ, of Aᵀ λ = ū, and with the
/// same A in both solves ⟨b̄, b⟩ = ⟨ū, u⟩ but for their residuals. In unrolled mode the two are equal after any number
/// of iterations, as t b in place of b makes t u of u. A wrong transpose, or a captured tensor that has changed, gives
/// a wrong gradient, and no solve knows.
class AdjointIdentity {
 public:
  /// Keeps b, u and the residual without a copy; on the CPU, where the host can look.
  void keep(const at::Tensor& b, const Solved& solved, bool unrolled);
  /// Warns, once for this `code`, of the first sample where the two differ by more than both residuals explain. Says
  /// nothing where b or u was written to since, or the adjoint solve failed.
  void check(const at::Tensor& cotangent, const at::Tensor& b_bar, const SolveInfo& adjoint, FunctionCode& code) const;
  bool has_kept() const { return b_.defined(); }
  void release() { b_ = u_ = residual_ = at::Tensor(); }

 private:
  at::Tensor b_, u_, residual_;
  bool unrolled_ = false;
  int64_t writes_ = 0;  // to b and u, when they were kept
};

}  // namespace prdp
