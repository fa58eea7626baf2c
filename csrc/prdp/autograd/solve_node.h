#pragma once
#include <torch/csrc/autograd/saved_variable.h>

#include "prdp/autograd/adjoint_identity.h"
#include "prdp/autograd/node_pointer.h"
#include "prdp/autograd/solve_vjp.h"
#include "prdp/operators/registered_products.h"
#include "prdp/solvers/warnings.h"

namespace prdp {

/// The backward pass of prdp::linear_solve. A Node like those of torch's own ops, because torch.func does
/// not take torch::autograd::Function of C++.
class SolveNode final : public torch::autograd::Node {
 public:
  SolveNode(const at::Tensor& b, OperatorSpec a, SolveOptions options);
  /// Call this once this node is the history of u.
  void save(const at::Tensor& b, const Solved& solved);

  torch::autograd::variable_list apply(torch::autograd::variable_list&& cotangents) override;
  void release_variables() override;
  std::string name() const override { return "LinearSolve"; }
  /// Those of the solve, with what it is to keep for the adjoint solve.
  const SolveOptions& options() const { return options_; }

 private:
  torch::autograd::variable_list gradients(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& a,
                                           const AdjointIdentity& identity) const;

  OperatorSpec a_;  // its tensors are among the saved ones
  SolveOptions options_;
  std::shared_ptr<const RegisteredProducts> products_, products_of_inverse_;  // of A and of its preconditioner
  std::pair<int64_t, int64_t> step_ = FailuresOfStep::now();  // of a rollout, for what the backward pass reports
  AdjointIdentity identity_;  // of a Function
  std::vector<torch::autograd::SavedVariable> tensors_;
  torch::autograd::SavedVariable b_, x0_, u_, iterations_, status_, residual_;
};

}  // namespace prdp
