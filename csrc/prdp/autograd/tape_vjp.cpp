#include <torch/csrc/autograd/autograd.h>

#include <algorithm>

#include "prdp/autograd/tape_samples.h"
#include "prdp/autograd/unrolled_vjp.h"
#include "prdp/operators/tensors.h"
#include "prdp/operators/with_autograd.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/solve.h"
#include "prdp/threads/share_samples.h"

namespace prdp {

namespace {

/// Adds what a sample has for tensor i of A to its gradient: all of it where the samples share the
/// tensor, else its row.
void add_sample(at::Tensor& gradient, const at::Tensor& tensor, const at::Tensor& of_sample, int64_t sample) {
  if (!gradient.defined()) gradient = at::zeros_like(tensor);
  (of_sample.sizes() == tensor.sizes() ? gradient : gradient.narrow(0, sample, 1)).add_(of_sample);
}

/// ∂⟨D̄, D(g)⟩/∂g for the diagonal D of A, of the samples that took an iteration: a refused operator
/// would send NaN even from behind zeros.
void add_diagonals(std::vector<at::Tensor>& gradients, const at::Tensor& diagonal_bar, const UnrolledSolve& solve,
                   at::IntArrayRef needed) {
  const auto index = solve.iterations.gt(0).nonzero().flatten();
  if (index.numel() == 0) return;
  auto spec = solve.a;
  std::vector<at::Tensor> inputs;
  for (size_t i = 0; i < spec.tensors.size(); ++i)
    if (needed[i + 1]) inputs.push_back(spec.tensors[i] = spec.tensors[i].detach().requires_grad_());
  const auto bar = diagonal_bar.index_select(0, index);
  const auto found = with_autograd([&] {
    const auto diagonal = make_operator(spec)->select(index)->diagonal();
    if (!diagonal.requires_grad()) return std::vector<at::Tensor>(inputs.size());
    return torch::autograd::grad({diagonal.to(bar.scalar_type()).expand_as(bar)}, inputs, {bar}, false, false,
                                 /*allow_unused=*/true);
  });
  for (size_t i = 0, next = 0; i < spec.tensors.size(); ++i)
    if (needed[i + 1]) add_to(gradients[i + 1], found[next++]);
}

}  // namespace

bool can_use_tape(const Operator& a, const UnrolledSolve& solve, const at::Tensor& b) {
  return b.is_cpu() && traits(solve.solver.method).has_tape && !solve.solver.preconditioner.is_operator() &&
         a.kernels(b, false);
}

UnrolledVjp tape_vjp(const at::Tensor& cotangent, const at::Tensor& b, const UnrolledSolve& solve,
                     at::IntArrayRef needed) {
  const auto a = make_operator(solve.a);
  const auto x0 = solve.x0.defined() ? solve.x0.contiguous() : at::Tensor();
  const auto rhs = b.contiguous(), bar = cotangent.contiguous(), iterations = solve.iterations.contiguous();
  const bool for_a = std::find(needed.begin() + 1, needed.end(), 1) != needed.end();
  const bool for_diagonal = for_a && divides_by_diagonal(solve.solver);
  const auto b_bar = at::empty_like(rhs), diagonal_bar = for_diagonal ? at::empty_like(rhs) : at::Tensor();
  UnrolledVjp found{std::vector<at::Tensor>(needed.size()), at::empty_like(iterations)};
  std::vector<std::vector<at::Tensor>> of_samples(rhs.size(0));

  const int64_t size = rhs.size(0), unknowns = rhs.numel() / std::max<int64_t>(size, 1);
  const int64_t most = size == 0 ? 0 : iterations.max().item<int64_t>();
  constexpr int64_t cost_of_reverse = 4;  // iterations that one takes, there and back
  const int64_t grain = grain_size(solve.solver.method, size, unknowns, cost_of_reverse * most, solve.solver.restart);
  const auto run = [&]<class T>(const kernels::KernelBatch<T>& of_a) {
    ReverseBatch<T> batch{.solver = solve.solver,
                          .checkpoint_every = solve.checkpoint_every,
                          .iterations = iterations.const_data_ptr<int64_t>(),
                          .b = rhs.const_data_ptr<T>(),
                          .x0 = x0.defined() ? x0.const_data_ptr<T>() : nullptr,
                          .cotangent = bar.const_data_ptr<T>(),
                          .b_bar = b_bar.mutable_data_ptr<T>(),
                          .diagonal_bar = for_diagonal ? diagonal_bar.mutable_data_ptr<T>() : nullptr,
                          .applications = found.operator_applications.mutable_data_ptr<int64_t>(),
                          .rows = {},
                          .take_gradients = {}};
    if (for_a) {
      batch.rows = [&](int64_t s) { return ProductRows(a->select(at::full({1}, s, at::kLong)), rhs); };
      batch.take_gradients = [&](int64_t s, std::vector<at::Tensor> g) { of_samples[s] = std::move(g); };
    }
    const auto transpose = a->kernels(b, true);
    share_samples(size, unknowns, grain, [&](int64_t begin, int64_t end) {
      const at::NoGradGuard no_grad;
      reverse_samples(of_a, std::get<kernels::KernelBatch<T>>(transpose->of_dtype), batch, unknowns, begin, end);
    });
  };
  const auto kernels = a->kernels(b, false);
  std::visit(run, kernels->of_dtype);

  if (needed[0]) found.gradients[0] = b_bar;
  for (int64_t s = 0; s < size; ++s)
    for (size_t i = 0; i < of_samples[s].size(); ++i)
      if (needed[i + 1] && of_samples[s][i].defined())
        add_sample(found.gradients[i + 1], solve.a.tensors[i], of_samples[s][i], s);
  if (for_diagonal) add_diagonals(found.gradients, diagonal_bar, solve, needed);
  else found.of_samples = std::move(of_samples);
  return found;
}

}  // namespace prdp
