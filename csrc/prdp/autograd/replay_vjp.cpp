#include <algorithm>

#include "prdp/autograd/stored_iterates.h"
#include "prdp/autograd/unrolled_vjp.h"
#include "prdp/operators/tensors.h"
#include "prdp/operators/with_autograd.h"
#include "prdp/solvers/solve_recorded.h"

namespace prdp {

namespace {

using State = StepwiseSolve::State;

/// The whole batch for run_back(): autograd records one iteration at a time and takes its
/// derivative before the next.
class Replay {
 public:
  /// Makes A out of the tensors that it depends on.
  using MakeOperator = std::function<std::unique_ptr<Operator>(const std::vector<at::Tensor>&)>;

  Replay(MakeOperator make, StepwiseSolve& solve, std::vector<at::Tensor> inputs, at::IntArrayRef needed,
         const at::Tensor& cotangent)
      : gradients(inputs.size()),
        make_(std::move(make)),
        solve_(solve),
        inputs_(std::move(inputs)),
        needed_(needed),
        cotangent_(cotangent) {}

  void start() { now_ = {}, done_ = 0; }
  void save(int64_t slot) {
    if (static_cast<size_t>(slot) >= kept_.size()) kept_.resize(slot + 1);
    kept_[slot] = now_;
  }
  void load(int64_t slot, int64_t k) { now_ = kept_[slot], done_ = k; }
  void step() { now_ = solve_.step(*make_(tensors()), inputs_[0], now_, done_++); }

  /// Records iteration k alone, from leaves: the state before it, and the inputs.
  void step_back(int64_t slot, int64_t k) {
    std::vector<at::Tensor> inputs = inputs_;
    State before = kept_[slot];
    for (auto& part : before) part = part.detach().requires_grad_();
    std::vector<int64_t> wanted(before.size(), 1);
    for (size_t i = 0; i < inputs.size(); ++i) {
      wanted.push_back(needed_[i] || i == 0);  // the right-hand side always: finish() takes its cotangent to those of A
      if (wanted.back()) inputs[i] = inputs[i].detach().requires_grad_();
    }
    const auto found = with_autograd([&] {
      const auto a = make_({inputs.begin() + 1, inputs.end()});
      const auto after = solve_.step(*a, inputs[0], before, k);
      if (bars_.empty()) bars_.push_back(solve_.scaled_back(*make_(tensors()), cotangent_));
      bars_.resize(after.size());  // after the last iteration, x alone has one
      auto leaves = before;
      leaves.insert(leaves.end(), inputs.begin(), inputs.end());
      return gradients_of(after, bars_, leaves, wanted);
    });
    bars_.assign(found.begin(), found.begin() + before.size());
    for (size_t i = 0; i < inputs.size(); ++i) add_to(gradients[i], found[before.size() + i]);
  }

  /// From the cotangent of the right-hand side, b - A start, to those of b and A.
  void finish() {
    gradients[0] = solve_.bar_of_b(*make_(tensors()), gradients[0]);
    if (!solve_.start().defined()) return;
    const auto of_tensors = needed_.slice(1);
    if (std::count(of_tensors.begin(), of_tensors.end(), 0) == std::ssize(of_tensors)) return;
    std::vector<at::Tensor> inputs = tensors();
    for (size_t i = 0; i < inputs.size(); ++i)
      if (of_tensors[i]) inputs[i] = inputs[i].detach().requires_grad_();
    const auto found = with_autograd(
        [&] { return gradients_of({make_(inputs)->apply(solve_.start())}, {gradients[0].neg()}, inputs, of_tensors); });
    for (size_t i = 0; i < inputs.size(); ++i) add_to(gradients[i + 1], found[i]);
  }

  std::vector<at::Tensor> gradients;  // of the right-hand side and the tensors of A

 private:
  std::vector<at::Tensor> tensors() const { return {inputs_.begin() + 1, inputs_.end()}; }

  MakeOperator make_;
  StepwiseSolve& solve_;
  std::vector<at::Tensor> inputs_;  // the right-hand side and the tensors of A
  at::IntArrayRef needed_;
  at::Tensor cotangent_;
  State now_;
  int64_t done_ = 0;
  std::vector<State> kept_;
  std::vector<at::Tensor> bars_;  // of the state, x first
};

}  // namespace

UnrolledVjp replay_vjp(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                       at::IntArrayRef needed) {
  UnrolledVjp found{std::vector<at::Tensor>(needed.size()), at::zeros({b.size(0)}, at::kLong)};
  const auto index = solve.iterations.gt(0).nonzero().flatten();
  if (index.numel() == 0) return found;

  // Samples of no iterations are left out where the operator can be had without them, and has no other beside it.
  const auto here = index.to(b.device());
  const bool part =
      index.numel() < b.size(0) && !solve.solver.preconditioner.is_operator() && make_operator(solve.a)->select(here);
  const auto make = [&](const std::vector<at::Tensor>& tensors) {
    auto spec = solve.a;
    spec.tensors = tensors;
    auto a = make_operator(spec);
    return part ? a->select(here) : std::move(a);
  };
  const auto of_part = [&](const at::Tensor& t, const at::Tensor& at) {
    return part && t.defined() ? t.index_select(0, at) : t;
  };
  const auto a = make(solve.a.tensors);
  StepwiseSolve stepwise(*a, solve.solver, of_part(b, here), of_part(solve.x0, here), of_part(solve.iterations, index));
  std::vector<at::Tensor> inputs{stepwise.rhs()};
  inputs.insert(inputs.end(), solve.a.tensors.begin(), solve.a.tensors.end());
  Replay replay(make, stepwise, inputs, needed, of_part(cotangent, here));
  run_back(replay, {stepwise.iterations(), solve.checkpoint_every});

  replay.finish();
  found.gradients = std::move(replay.gradients);
  auto applications = at::tensor(at::IntArrayRef(stepwise.applications()), at::kLong);
  if (part) {
    found.gradients[0] = at::zeros_like(b).index_copy(0, here, found.gradients[0]);
    applications = at::zeros({b.size(0)}, at::kLong).index_copy(0, index.cpu(), applications);
  }
  found.operator_applications = applications;
  for (size_t i = 0; i < needed.size(); ++i)
    if (!needed[i]) found.gradients[i] = at::Tensor();
  return found;
}

}  // namespace prdp
