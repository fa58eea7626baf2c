#include "prdp/operators/stencil_direct.h"

#include <ATen/core/grad_mode.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/custom_class.h>

#include <cmath>
#include <functional>
#include <map>

#include "prdp/operators/cyclic_reduction.h"
#include "prdp/operators/dense.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/operators/tensor_axes.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

/// A cheap way for some samples of a batch, or for all.
struct Way {
  std::function<at::Tensor(const at::Tensor& b)> solve;  // empty: there is none for any sample
  at::Tensor rest{};  // of which samples what it says is not to be used, (batch or 1,); undefined: none
};

Way way_but_for(const std::vector<bool>& rest, const at::Device& device, decltype(Way::solve) solve) {
  const auto count = std::count(rest.begin(), rest.end(), true);
  if (count == std::ssize(rest)) return {};
  if (count == 0) return {std::move(solve)};
  auto mask = at::empty({std::ssize(rest)}, at::kBool);
  std::copy(rest.begin(), rest.end(), mask.mutable_data_ptr<bool>());
  return {std::move(solve), mask.to(device)};
}

Way solve_line(const at::Tensor& coefficients, const NamedNullSpace& null_space) {
  if (null_space.vectors > 0 && !null_space.is_constant) return {};
  const CyclicReduction line(coefficients.to(at::kDouble), 8.0 * epsilon_of(coefficients));
  const auto dominant = line.is_dominant().to(at::kCPU);
  std::vector<bool> rest;
  for (int64_t s = 0; s < dominant.size(0); ++s) rest.push_back(!dominant.const_data_ptr<bool>()[s]);
  return way_but_for(rest, coefficients.device(), [line, null_space](const at::Tensor& b) {
    const auto rhs = b.to(at::kDouble);
    return (null_space.is_constant ? line.solve_with_constant(rhs) : line.solve(rhs)).to(b.scalar_type());
  });
}

/// The coefficients (batch or 1, 1 + 2 dim, *shape) on the line of points through the first one: (batch or 1, k, n).
at::Tensor line_along(const at::Tensor& coefficients, int64_t axis) {
  auto line = coefficients;
  for (int64_t d = coefficients.dim() - 1; d >= 2; --d)
    if (d != 2 + axis) line = line.select(d, 0);
  return line;
}

/// How far, at most, the coefficients of each sample are from those of the sum that these lines tell.
at::Tensor distance_from_sum(const at::Tensor& coefficients, const std::vector<at::Tensor>& lines) {
  const auto dim = static_cast<int64_t>(lines.size());
  at::Tensor diagonal;
  std::vector<at::Tensor> sides;
  for (int64_t axis = 0; axis < dim; ++axis) {
    std::vector<int64_t> along(dim + 1, 1);
    along[0] = coefficients.size(0);
    along[1 + axis] = coefficients.size(2 + axis);
    const auto field = [&](int64_t k) { return lines[axis].select(1, k).reshape(along); };
    add_to(diagonal, axis == 0 ? field(0) : field(0) - per_sample(lines[axis].select(1, 0).select(1, 0), diagonal));
    for (const int64_t k : {1 + 2 * axis, 2 + 2 * axis}) sides.push_back(coefficients.select(1, k) - field(k));
  }
  sides.push_back(coefficients.select(1, 0) - diagonal);
  return at::stack(sides, 1).abs().flatten(1).amax(1);
}

/// A sum over axes from its lines on the host, as `host` has them one behind the other.
kernels::SumOverAxes sum_of(const double* host, at::IntArrayRef shape, const std::vector<bool>& periodic) {
  const auto dim = static_cast<int64_t>(shape.size());
  kernels::SumOverAxes sum;
  for (int64_t axis = dim - 3; axis < dim; ++axis) {
    const int64_t n = axis < 0 ? 1 : shape[axis];
    auto& a = sum[3 - dim + axis];
    a.setZero(n, n);
    if (axis < 0) continue;
    const double *diagonal = host, *before = host + (1 + 2 * axis) * n, *behind = before + n;
    for (int64_t i = 0; i < n; ++i) {
      a(i, i) = diagonal[i] - (axis + 1 == dim ? 0.0 : diagonal[0]);
      if (const auto j = kernels::neighbour(i, -1, n, periodic[axis]); j >= 0) a(i, j) = before[i];
      if (const auto j = kernels::neighbour(i, 1, n, periodic[axis]); j >= 0) a(i, j) = behind[i];
    }
    host += (1 + 2 * dim) * n;
  }
  return sum;
}

/// What is read of a sum on the host: its lines, how far the coefficients are from it, the norm, and the diagonal.
class SumOnHost {
 public:
  SumOnHost(const at::Tensor& coefficients, const std::vector<bool>& periodic)
      : shape_(coefficients.sizes().slice(2).vec()), periodic_(periodic), epsilon_(epsilon_of(coefficients)) {
    std::vector<at::Tensor> lines, told;
    for (int64_t axis = 0; axis < std::ssize(shape_); ++axis) {
      lines.push_back(line_along(coefficients, axis));
      told.push_back(lines.back().flatten(1));
    }
    const auto diagonal = coefficients.select(1, 0).abs().flatten(1);
    told.push_back(at::stack({distance_from_sum(coefficients, lines), coefficients.abs().sum(1).flatten(1).amax(1),
                              diagonal.amin(1), diagonal.amax(1)},
                             1));
    host_ = at::cat(told, 1).to(at::kCPU, at::kDouble).contiguous();
  }
  int64_t samples() const { return host_.size(0); }
  bool is_finite(int64_t s) const { return std::isfinite(norm(s)); }
  bool is_sum(int64_t s) const {
    const double distance = rest(s)[0], least = rest(s)[2], most = rest(s)[3];
    return distance <= slack(s) && most <= kernels::kWidestRows * least;
  }
  /// Nothing unless it is symmetric.
  std::optional<kernels::SumOverAxes> sum(int64_t s) const {
    const auto a = sum_of(lines(s), shape_, periodic_);
    const bool symmetric =
        std::all_of(a.begin(), a.end(), [&](const auto& m) { return kernels::is_symmetric(m, slack(s)); });
    return symmetric ? std::optional(a) : std::nullopt;
  }
  kernels::FactorKey key(int64_t s, int64_t null_vectors, const at::TensorOptions& options) const {
    const auto device = options.device();
    const auto dtype = c10::typeMetaToScalarType(options.dtype());
    kernels::FactorKeyMaker key;
    key.add(lines(s), host_.size(1) - 4).add(shape_.data(), std::ssize(shape_)).add(null_vectors);
    for (const bool closed : periodic_) key.add(int64_t{closed});
    return key.add(static_cast<int64_t>(dtype))
        .add(static_cast<int64_t>(device.type()))
        .add(int64_t{device.index()})
        .key();
  }
  double epsilon() const { return epsilon_; }
  const std::vector<int64_t>& shape() const { return shape_; }

 private:
  const double* lines(int64_t s) const { return host_.const_data_ptr<double>() + s * host_.size(1); }
  const double* rest(int64_t s) const { return lines(s) + host_.size(1) - 4; }
  double norm(int64_t s) const { return rest(s)[1]; }
  double slack(int64_t s) const { return kernels::slack_of_sum(norm(s), epsilon_); }

  std::vector<int64_t> shape_;
  std::vector<bool> periodic_;
  double epsilon_;
  at::Tensor host_;
};

using Inverse = std::shared_ptr<const TensorAxes>;

/// Null if the sample is no such sum.
Inverse inverse_of(const SumOnHost& told, int64_t s, int64_t null_vectors, const at::TensorOptions& options) {
  if (!told.is_finite(s) || !told.is_sum(s)) return nullptr;
  const auto sum = told.sum(s);
  if (!sum) return nullptr;
  return factor_cache::find_or_make<TensorAxes>(told.key(s, null_vectors, options), [&] {
    return std::make_shared<TensorAxes>(kernels::diagonalise(*sum, told.epsilon(), null_vectors), told.shape(),
                                        options);
  });
}

/// Samples of the same inverse at once.
at::Tensor solve_by(const std::vector<Inverse>& inverses, const at::Tensor& b) {
  const auto solve = [](const Inverse& inverse, const at::Tensor& part) {
    return inverse ? inverse->solve(part) : at::full_like(part, NAN);
  };
  if (std::all_of(inverses.begin(), inverses.end(), [&](const auto& i) { return i == inverses[0]; }))
    return solve(inverses[0], b);
  std::map<Inverse, std::vector<int64_t>> groups;
  for (size_t s = 0; s < inverses.size(); ++s) groups[inverses[s]].push_back(static_cast<int64_t>(s));
  auto u = at::empty_like(b);
  for (const auto& [inverse, samples] : groups) {
    const auto index = at::tensor(samples, at::kLong).to(b.device());
    u.index_copy_(0, index, solve(inverse, b.index_select(0, index)));
  }
  return u;
}

Way solve_sum(const at::Tensor& coefficients, const std::vector<bool>& periodic, int64_t null_vectors) {
  const SumOnHost told(coefficients, periodic);
  std::vector<Inverse> inverses;
  std::vector<bool> rest;
  for (int64_t s = 0; s < told.samples(); ++s) {
    inverses.push_back(inverse_of(told, s, null_vectors, coefficients.options()));
    rest.push_back(!inverses.back() && told.is_finite(s));
  }
  return way_but_for(rest, coefficients.device(), [inverses](const at::Tensor& b) { return solve_by(inverses, b); });
}

Way find_way(const OperatorSpec& a, const NamedNullSpace& null_space) {
  const at::NoGradGuard no_grad;
  auto plain = a;
  plain.tensors[0] = a.tensors[0].detach();
  const auto dim = static_cast<int64_t>(a.shape.size());
  std::array<int64_t, 3> shape{1, 1, 1};
  std::copy(a.shape.begin(), a.shape.end(), shape.end() - dim);
  if (dim > 1 && !kernels::has_axes_to_diagonalise(dim, shape.data())) return {};
  const auto coefficients =
      StencilOperator(plain).nearest_coefficients(a.transposed && dim == 1);  // sums are symmetric
  if (!coefficients.defined()) return {};
  if (dim == 1) return solve_line(coefficients, null_space);
  return solve_sum(coefficients, {a.parameters.begin(), a.parameters.begin() + dim}, null_space.vectors);
}

at::Tensor solve_densely(const OperatorSpec& a, const at::Tensor& b) {
  const StencilOperator stencil(a);
  check_dense_fits(b, b.numel() / (b.size(0) * b.size(1)), a.tensors[0].size(0));
  const auto matrix = channel_matrix(stencil, a.tensors[0].options());
  return solve_channels(a.transposed ? matrix.mT() : matrix, b);
}

/// What a solve on the axes needs for its derivative, but for tensors.
struct Plan : public torch::CustomClassHolder {
  Plan(Way way, OperatorSpec a, const NamedNullSpace& null_space)
      : way(std::move(way)), a(std::move(a)), null_space(null_space) {
    this->a.tensors.clear();
  }
  Way way;
  OperatorSpec a;
  NamedNullSpace null_space;
};

at::Tensor solve_planned(const Plan& plan, const at::Tensor& coefficients, const at::Tensor& b) {
  const auto u = plan.way.solve(b);
  if (!plan.way.rest.defined()) return u;
  auto a = plan.a;
  a.tensors = {coefficients};
  return at::where(per_sample(plan.way.rest, b), solve_densely(a, b), u);
}

/// The derivative is that of the exact solution, by one more solve and the product rule.
class SolveStencil : public torch::autograd::Function<SolveStencil> {
 public:
  static at::Tensor forward(AutogradContext* ctx, const at::Tensor& coefficients, const at::Tensor& b,
                            const c10::intrusive_ptr<Plan>& plan) {
    const auto u = solve_planned(*plan, coefficients, b);
    ctx->save_for_backward({coefficients, u});
    ctx->saved_data["plan"] = c10::IValue::make_capsule(plan);
    return u;
  }
  static variable_list backward(AutogradContext* ctx, const variable_list& grads) {
    const auto plan = c10::static_intrusive_pointer_cast<Plan>(ctx->saved_data["plan"].toCapsule());
    const auto saved = ctx->get_saved_variables();
    auto a = plan->a;
    a.tensors = {saved[0]};
    const StencilOperator stencil(a);
    a.transposed = !a.transposed;
    const auto lambda = solve_stencil_on_axes(a, grads[0], plan->null_space);
    TORCH_INTERNAL_ASSERT(lambda, "there is a way to solve with A, but not with its transpose");
    if (!ctx->needs_input_grad(0)) return {{}, *lambda, {}};
    const auto& u = saved[1];
    return {-(a.transposed ? stencil.product_rule(*lambda, u) : stencil.product_rule(u, *lambda))[0], *lambda, {}};
  }
};

}  // namespace

std::optional<at::Tensor> solve_stencil_on_axes(const OperatorSpec& a, const at::Tensor& b,
                                                const NamedNullSpace& null_space) {
  auto way = find_way(a, null_space);
  if (!way.solve || (way.rest.defined() && null_space.vectors > 0)) return std::nullopt;
  return SolveStencil::apply(a.tensors[0], b, c10::make_intrusive<Plan>(std::move(way), a, null_space));
}

at::Tensor solve_stencil_directly(const OperatorSpec& a, const at::Tensor& b) {
  if (!b.is_cpu())
    if (auto u = solve_stencil_on_axes(a, b, {})) return *std::move(u);
  return solve_densely(a, b);
}

}  // namespace prdp
