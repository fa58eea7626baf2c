#pragma once
#include "prdp/autograd/solve_vjp.h"
#include "prdp/steppers/flow/equation.h"

namespace prdp {

/// The reports of the solves of a time step as one: the sum of their work, the worst status, the largest residual.
class CombinedInfo {
 public:
  void add(const SolveInfo& info) { infos_.push_back(info); }
  const SolveInfo& last() const { return infos_.back(); }
  /// `refused`, (batch,): 0, or the status of a sample that was refused before; undefined: none was.
  SolveInfo info(const at::Tensor& refused = {}) const;

 private:
  std::vector<SolveInfo> infos_;
};

/// A u = b, differentiable in b and the tensors of A.
at::Tensor counted_solve(const OperatorSpec& a, const at::Tensor& b, const SolveOptions& options, CombinedInfo& info);
/// The cotangent of b from that of u, by one adjoint solve; and that of the first tensor of A where `u` is given.
struct SystemVjp {
  at::Tensor b, coefficients;
};
SystemVjp counted_adjoint_solve(const OperatorSpec& a, const at::Tensor& cotangent, const at::Tensor& u,
                                const SolveOptions& options, CombinedInfo& info);

}  // namespace prdp
