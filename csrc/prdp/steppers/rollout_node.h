#pragma once
#include "prdp/autograd/op_results.h"
#include "prdp/steppers/rollout_vjp.h"

/// The ops prdp::rollout_solves and prdp::rollout_vjp. A rollout is a row of solves, picard_steps to a step: solve s
/// takes its winds from solution s and its right-hand side from the first solution of its step, and makes solution
/// s + 1. Solution 0 is u.
namespace prdp {

/// rollout_solves with its derivative: one node of autograd (rollout_node.cpp).
SolveOutputs record_rollout(const Equation& equation, const at::Tensor& u, const c10::SymInt& solves,
                            const SolveOptions& options);

/// Both ops below autograd (rollout_op.cpp). Where all tensors are plain they do not cross the dispatcher, which takes
/// longer than a small solve. The gradients are those that are needed, one for each 1 in `needed`.
SolveOutputs rollout_below_autograd(const Equation& equation, const at::Tensor& u, const c10::SymInt& solves,
                                    const SolveOptions& options);
std::vector<at::Tensor> rollout_vjp_below_autograd(const at::Tensor& cotangent, const KeptSolves& kept,
                                                   const Equation& equation, const SolveOptions& options,
                                                   at::IntArrayRef needed);

}  // namespace prdp
