#include "prdp/autograd/solve_node.h"

#include "prdp/autograd/for_each_cotangent.h"
#include "prdp/operators/autocast.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/kept_hierarchy.h"
#include "prdp/solvers/report_failures.h"

namespace prdp {

using torch::autograd::SavedVariable;
using torch::autograd::variable_list;

SolveNode::SolveNode(const at::Tensor& b, OperatorSpec a, SolveOptions options)
    : Node(torch::autograd::collect_next_edges(b, at::TensorList(a.tensors))),
      a_(std::move(a)),
      options_(std::move(options)),
      products_(products_of(a_)),
      products_of_inverse_(products_of(options_.solver.preconditioner.spec())) {
  if (options_.backward == Backward::kImplicit && is_plain(b)) gpu::share_hierarchy(options_, b);
  if (options_.backward == Backward::kUnrolled && any_requires_grad(options_.solver.preconditioner.spec().tensors))
    warn_of_constant_preconditioner();
}

void SolveNode::save(const at::Tensor& b, const Solved& solved) {
  // Implicit mode keeps u alone, and that only if A has a derivative; b and what the solve said are unrolled mode's. Of
  // a Function all of them serve to check its derivative. Where a failed sample may have passed, its status says so.
  const bool unrolled = options_.backward == Backward::kUnrolled;
  if (unrolled) {
    b_ = SavedVariable(b, /*is_output=*/false);
    x0_ = SavedVariable(solved.x0, /*is_output=*/false);
    iterations_ = SavedVariable(solved.iterations, /*is_output=*/false);
    residual_ = SavedVariable(solved.residual, /*is_output=*/false);
  } else if (any_requires_grad(a_.tensors)) {
    u_ = SavedVariable(solved.u, /*is_output=*/true);
  }
  if (unrolled || options_.on_failure != OnFailure::kRaise) status_ = SavedVariable(solved.status, /*is_output=*/false);
  const bool can_differ = is_function(a_) && !is_singular(a_) && all_plain(a_.tensors);
  if (can_differ && waits_for_report(options_)) identity_.keep(b, solved);
  for (const auto& t : a_.tensors) tensors_.emplace_back(t, /*is_output=*/false);
  a_.tensors.clear();
}

void SolveNode::release_variables() {
  const std::lock_guard lock(mutex_);
  for (auto* saved : {&b_, &x0_, &u_, &iterations_, &status_, &residual_}) saved->reset_data();
  for (auto& saved : tensors_) saved.reset_data();
  identity_.release();
  if (options_.hierarchy) options_.hierarchy->let_go();
}

variable_list SolveNode::apply(variable_list&& cotangents) {
  const auto& cotangent = cotangents[0];
  if (!cotangent.defined()) return variable_list(tensors_.size() + 1);
  auto a = a_;
  Solved solved;
  AdjointIdentity identity;
  {
    const std::lock_guard lock(mutex_);
    // The function that torch.func.vjp returns runs after its transform: the wrappers are dead by then.
    const auto unpack = [](const SavedVariable& saved, NodePointer<Node> of = nullptr) {
      return at::functorch::unwrapIfDead(saved.unpack(std::move(of)));
    };
    solved = {unpack(b_), unpack(u_, getptr()), unpack(iterations_), unpack(status_), unpack(residual_), unpack(x0_)};
    identity = identity_;
    for (const auto& saved : tensors_) a.tensors.push_back(unpack(saved));
  }
  const WithoutAutocast full_precision;
  const FailuresOfStep here(step_.first, step_.second);
  return for_each_cotangent(cotangent, [&](const at::Tensor& one) { return gradients(one, solved, a, identity); });
}

variable_list SolveNode::gradients(const at::Tensor& cotangent, const Solved& solved, const OperatorSpec& a,
                                   const AdjointIdentity& identity) const {
  std::vector<int64_t> needed(a.tensors.size() + 1);
  for (size_t i = 0; i < needed.size(); ++i) needed[i] = task_should_compute_output(i);
  const bool by_kernel = !at::GradMode::is_enabled() && is_plain(cotangent) && all_plain(a.tensors) &&
                         !has_tangent(cotangent) && !any_tangent(a.tensors);
  const auto vjp = [&](at::IntArrayRef wanted) {
    return solve_vjp(cotangent, solved, a, options_, wanted, by_kernel ? linear_solve_unrecorded : linear_solve);
  };
  const bool unrolled = options_.backward == Backward::kUnrolled;
  if (unrolled && identity.has_kept()) identity.check_product(*make_operator(a), *products_->code);
  if (unrolled || !by_kernel || !identity.has_kept()) return vjp(needed).gradients;
  auto with_lambda = needed;
  with_lambda[0] = 1;
  auto found = vjp(with_lambda);
  identity.check_adjoint(cotangent, found.gradients[0], found.info, *products_->code);
  if (!needed[0]) found.gradients[0] = at::Tensor();
  return std::move(found.gradients);
}

}  // namespace prdp
