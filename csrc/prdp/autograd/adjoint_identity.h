#pragma once
#include "prdp/autograd/solve_vjp.h"
#include "prdp/operators/registered_products.h"

namespace prdp {

/// What a solve A u = b with a Function keeps for a look at its gradient, which may be made with another A: by a wrong
/// transpose, or where what the functions captured has changed since.
class AdjointIdentity {
 public:
  /// Keeps b, u and the residual without a copy; on the CPU, where the host can look.
  void keep(const at::Tensor& b, const Solved& solved);
  bool has_kept() const { return b_.defined(); }
  void release() { b_ = u_ = residual_ = at::Tensor(); }

  // Each warns once for this `code`, of the first sample that differs by more than the residuals explain, and says
  // nothing where b or u was written to since, or a solve failed.
  /// In implicit mode: with the same A in the solve and in the adjoint solve Aᵀ λ = ū, ⟨λ, b⟩ = ⟨u, ū⟩.
  void check_adjoint(const at::Tensor& cotangent, const at::Tensor& lambda, const SolveInfo& adjoint,
                     FunctionCode& code) const;
  /// In unrolled mode, before it makes the products again: b - A u is still the residual.
  void check_product(const Operator& a, FunctionCode& code) const;

 private:
  bool can_compare() const;

  at::Tensor b_, u_, residual_;
  int64_t writes_ = 0;  // to b and u, when they were kept
};

}  // namespace prdp
