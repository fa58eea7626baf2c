#include "prdp/operators/stencil_direct.h"

#include <ATen/core/grad_mode.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/custom_class.h>

#include <cmath>
#include <functional>
#include <map>

#include "prdp/operators/cyclic_reduction.h"
#include "prdp/operators/dense.h"
#include "prdp/operators/remembered.h"
#include "prdp/operators/saved_outputs.h"
#include "prdp/operators/separability.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

// Two kinds of stencils have a cheap way: those in 1D, by cyclic reduction where they are diagonally dominant
// (solve_line), and symmetric sums of operators along the axes, in their eigenvectors (solve_sum). The others, or the
// samples that are of neither kind, take a dense matrix (solve_densely). The derivative is the same for all
// (SolveStencil).

/// A solve that is cheap, for some samples of a batch or for all.
struct FastSolve {
  std::function<at::Tensor(const at::Tensor& b)> solve;  // empty: there is none for any sample
  at::Tensor unsolved{};  // the samples that it does not solve, (batch or 1,); undefined: none
};

FastSolve with_dense_fallback(const std::vector<bool>& unsolved, const at::Device& device,
                              decltype(FastSolve::solve) solve) {
  const auto count = std::count(unsolved.begin(), unsolved.end(), true);
  if (count == std::ssize(unsolved)) return {};
  if (count == 0) return {std::move(solve)};
  auto mask = at::empty({std::ssize(unsolved)}, at::kBool);
  std::copy(unsolved.begin(), unsolved.end(), mask.mutable_data_ptr<bool>());
  return {std::move(solve), mask.to(device)};
}

std::vector<bool> periodic_axes(const OperatorSpec& a) {
  return {a.parameters.begin(), a.parameters.begin() + std::ssize(a.shape)};
}

OperatorSpec detached(OperatorSpec a) {
  a.tensors[0] = a.tensors[0].detach();
  return a;
}

FastSolve solve_line(const at::Tensor& coefficients, const NamedNullSpace& null_space) {
  if (null_space.vectors > 0 && !null_space.is_constant) return {};
  const auto real = widest_real(coefficients.device());
  const CyclicReduction line(coefficients.to(real), 8.0 * epsilon_of(coefficients));
  const auto dominant = line.is_dominant().to(at::kCPU);
  std::vector<bool> unsolved;
  for (int64_t s = 0; s < dominant.size(0); ++s) unsolved.push_back(!dominant.const_data_ptr<bool>()[s]);
  return with_dense_fallback(unsolved, coefficients.device(), [line, null_space, real](const at::Tensor& b) {
    const auto rhs = b.to(real);
    return (null_space.is_constant ? line.solve_with_constant(rhs) : line.solve(rhs)).to(b.scalar_type());
  });
}

using Inverse = std::shared_ptr<const SeparableInverse>;

/// The keys of what the last few coefficients led to on this thread, which need not be looked at again: those of a flow
/// are the same tensors in every step.
class RecentFactors {
 public:
  /// Empty if any of them is not known any more.
  std::vector<Inverse> find(const OperatorSpec& a, int64_t null_vectors) const {
    for (const auto& known : known_) {
      if (known.null_vectors != null_vectors || !known.of.matches(a, a.tensors[0].scalar_type())) continue;
      std::vector<Inverse> inverses;
      for (const auto& key : known.keys)
        if (auto kept = factor_cache::find(key, typeid(SeparableInverse)))
          inverses.push_back(std::static_pointer_cast<const SeparableInverse>(std::move(kept)));
      if (inverses.size() == known.keys.size()) return inverses;
    }
    return {};
  }
  void keep(const OperatorSpec& a, int64_t null_vectors, std::vector<kernels::FactorKey> keys) {
    auto& oldest = known_[next_++ % known_.size()];
    oldest.of.store(a, a.tensors[0].scalar_type());
    oldest.null_vectors = null_vectors;
    oldest.keys = std::move(keys);
  }
  static RecentFactors& local() {
    static thread_local RecentFactors last;
    return last;
  }

 private:
  struct Known {
    SpecFingerprint of;
    int64_t null_vectors = 0;
    std::vector<kernels::FactorKey> keys;
  };
  std::array<Known, 4> known_;
  size_t next_ = 0;
};

/// Null if the sample is no such sum.
Inverse inverse_of(const Separability& separable, int64_t s, const kernels::FactorKey& key, int64_t null_vectors,
                   const at::TensorOptions& options) {
  const auto sum = separable.is_finite(s) ? separable.sum(s) : std::nullopt;
  if (!sum) return nullptr;
  return factor_cache::find_or_make<SeparableInverse>(key, [&] {
    return std::make_shared<SeparableInverse>(kernels::diagonalise(*sum, separable.epsilon(), null_vectors),
                                              separable.inner_box(s), options);
  });
}

/// Samples of the same inverse at once.
at::Tensor solve_by(const std::vector<Inverse>& inverses, const at::Tensor& b, const at::Tensor& diagonal) {
  const auto solve = [&](const Inverse& inverse, const at::Tensor& part, const at::Tensor& its_diagonal) {
    return inverse ? inverse->solve(part, its_diagonal) : at::full_like(part, NAN);
  };
  if (std::all_of(inverses.begin(), inverses.end(), [&](const auto& i) { return i == inverses[0]; }))
    return solve(inverses[0], b, diagonal);
  std::map<Inverse, std::vector<int64_t>> groups;
  for (size_t s = 0; s < inverses.size(); ++s) groups[inverses[s]].push_back(static_cast<int64_t>(s));
  auto u = at::empty_like(b);
  for (const auto& [inverse, samples] : groups) {
    const auto index = at::tensor(samples, at::kLong).to(b.device());
    u.index_copy_(0, index, solve(inverse, b.index_select(0, index), diagonal.index_select(0, index)));
  }
  return u;
}

FastSolve solve_sum(const OperatorSpec& a, int64_t null_vectors) {
  auto inverses = RecentFactors::local().find(a, null_vectors);
  std::vector<bool> unsolved(inverses.size());
  if (inverses.empty()) {
    const auto coefficients =
        StencilOperator(detached(a)).nearest_coefficients(/*transposed=*/false);  // sums are symmetric
    if (!coefficients.defined()) return {};
    const Separability separable(coefficients, periodic_axes(a));
    std::vector<kernels::FactorKey> keys;
    for (int64_t s = 0; s < separable.samples(); ++s) {
      keys.push_back(separable.key(s, null_vectors, coefficients.options()));
      inverses.push_back(inverse_of(separable, s, keys.back(), null_vectors, coefficients.options()));
      unsolved.push_back(!inverses.back() && separable.is_finite(s));
    }
    const auto is_null = [](const Inverse& inverse) { return !inverse; };
    if (std::none_of(inverses.begin(), inverses.end(), is_null))
      RecentFactors::local().keep(a, null_vectors, std::move(keys));
  }
  const auto diagonal = StencilOperator(detached(a)).diagonal();
  return with_dense_fallback(unsolved, a.tensors[0].device(),
                             [inverses, diagonal](const at::Tensor& b) { return solve_by(inverses, b, diagonal); });
}

FastSolve find_fast_solve(const OperatorSpec& a, const NamedNullSpace& null_space) {
  const at::NoGradGuard no_grad;
  const auto dim = static_cast<int64_t>(a.shape.size());
  if (dim == 1) {
    const auto coefficients = StencilOperator(detached(a)).nearest_coefficients(a.transposed);
    return coefficients.defined() ? solve_line(coefficients, null_space) : FastSolve{};
  }
  std::array<int64_t, 3> shape{1, 1, 1};
  std::copy(a.shape.begin(), a.shape.end(), shape.end() - dim);
  return kernels::has_axes_to_diagonalise(dim, shape.data()) ? solve_sum(a, null_space.vectors) : FastSolve{};
}

at::Tensor solve_densely(const OperatorSpec& a, const at::Tensor& b) {
  const StencilOperator stencil(a);
  check_dense_fits(b, b.numel() / (b.size(0) * b.size(1)), a.tensors[0].size(0));
  const auto matrix = channel_matrix(stencil, a.tensors[0].options());
  return solve_channels(a.transposed ? matrix.mT() : matrix, b);
}

/// What a solve on the axes needs for its derivative, but for tensors.
struct Plan : public torch::CustomClassHolder {
  Plan(FastSolve fast, OperatorSpec a, const NamedNullSpace& null_space)
      : fast(std::move(fast)), a(std::move(a)), null_space(null_space) {
    this->a.tensors.clear();
  }
  FastSolve fast;
  OperatorSpec a;
  NamedNullSpace null_space;
  at::Tensor saved_output{};  // within forward()
};

at::Tensor solve_planned(const Plan& plan, const at::Tensor& coefficients, const at::Tensor& b) {
  const auto u = plan.fast.solve(b);
  if (!plan.fast.unsolved.defined()) return u;
  auto a = plan.a;
  a.tensors = {coefficients};
  return at::where(per_sample(plan.fast.unsolved, b), solve_densely(a, b), u);
}

/// The derivative is that of the exact solution, by one more solve and the product rule.
class SolveStencil : public torch::autograd::Function<SolveStencil> {
 public:
  static at::Tensor forward(AutogradContext* ctx, const at::Tensor& coefficients, const at::Tensor& b,
                            const c10::intrusive_ptr<Plan>& plan) {
    const auto u = solve_planned(*plan, coefficients, b);
    ctx->save_for_backward({coefficients, u});
    ctx->saved_data["plan"] = c10::IValue::make_capsule(plan);
    return plan->saved_output = u;
  }
  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    const auto plan = c10::static_intrusive_pointer_cast<Plan>(ctx->saved_data["plan"].toCapsule());
    const auto saved = ctx->get_saved_variables();
    auto a = plan->a;
    a.tensors = {saved[0]};
    const StencilOperator stencil(a);
    a.transposed = !a.transposed;
    const auto lambda = solve_stencil_on_axes(a, grads[0], plan->null_space);
    TORCH_INTERNAL_ASSERT(lambda, "there is a fast solve with A, but not with its transpose");
    if (!ctx->needs_input_grad(0)) return {{}, *lambda, {}};
    const auto& u = saved[1];
    return {-(a.transposed ? stencil.product_rule(*lambda, u) : stencil.product_rule(u, *lambda))[0], *lambda, {}};
  }
};

}  // namespace

std::optional<at::Tensor> solve_stencil_on_axes(const OperatorSpec& a, const at::Tensor& b,
                                                const NamedNullSpace& null_space) {
  auto fast = find_fast_solve(a, null_space);
  if (!fast.solve || (fast.unsolved.defined() && null_space.vectors > 0)) return std::nullopt;
  const auto plan = c10::make_intrusive<Plan>(std::move(fast), a, null_space);
  return apply_with_saved_output<SolveStencil>(plan->saved_output, a.tensors[0], b, plan);
}

at::Tensor solve_stencil_directly(const OperatorSpec& a, const at::Tensor& b) {
  if (!b.is_cpu())
    if (auto u = solve_stencil_on_axes(a, b, {})) return *std::move(u);
  return solve_densely(a, b);
}

}  // namespace prdp
