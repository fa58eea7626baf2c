#pragma once
#include "prdp/autograd/solve_vjp.h"
#include "prdp/steppers/flow/equation.h"

namespace prdp {

/// The reports of the solves of a time step as one: the sum of their work, the worst status, the largest residual.
class CombinedInfo {
 public:
  void add(const SolveInfo& info);
  const SolveInfo& info() const { return info_; }

 private:
  SolveInfo info_;
};

/// A symmetric system of a flow: all its right-hand sides are solved by one matrix.
struct FlowSystem {
  OperatorSpec a;
  SolveOptions options;
  bool singular = false;  // a constant of each closed part of the fluid is in its null space
};

/// A u = b, differentiable in b and the coefficients.
at::Tensor solve(const FlowBox& box, const FlowSystem& system, const at::Tensor& b, CombinedInfo& info);
/// The cotangent of b from that of u, by one adjoint solve; and that of the coefficients where `u` is given.
struct SystemVjp {
  at::Tensor b, coefficients;
};
SystemVjp solve_vjp(const FlowBox& box, const FlowSystem& system, const at::Tensor& cotangent, const at::Tensor& u,
                    CombinedInfo& info);

}  // namespace prdp
