#include "prdp/operators/diffusion_operator.h"

#include <ATen/core/grad_mode.h>

#include <limits>

#include "prdp/gpu/operator_view.h"
#include "prdp/operators/sets_of_samples.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/operators/step_parameters.h"
#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensor_factor_key.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

/// t without its last, and without its first entries along an axis of the grid.
at::Tensor below(const at::Tensor& t, int64_t axis) { return t.narrow(axis, 0, t.size(axis) - 1); }
at::Tensor above(const at::Tensor& t, int64_t axis) { return t.narrow(axis, 1, t.size(axis) - 1); }
at::Tensor first(const at::Tensor& t, int64_t axis) { return t.narrow(axis, 0, 1); }
at::Tensor last(const at::Tensor& t, int64_t axis) { return t.narrow(axis, t.size(axis) - 1, 1); }

/// a and b behind each other, where either may be the same for all samples.
at::Tensor joined_along(const at::Tensor& a, const at::Tensor& b, int64_t axis) {
  if (a.sym_size(0) == b.sym_size(0)) return at::cat({a, b}, axis);
  const auto grown = [batch = a.size(0) == 1 ? b.size(0) : a.size(0)](const at::Tensor& t) {
    auto sizes = t.sizes().vec();
    sizes[0] = batch;
    return t.expand(sizes);
  };
  return at::cat({grown(a), grown(b)}, axis);
}

at::Tensor or_nan(const at::Tensor& t, const at::Tensor& allowed) {
  return t.masked_fill(allowed.logical_not(), std::numeric_limits<double>::quiet_NaN());
}

/// Of two conductances a > 0 and b >= 0 in series, a b/(a + b), as s/(1 + s/l) of the smaller and the larger one: what
/// autograd makes of that neither cancels, where a quotient by a + b does, nor overflows, and b may be infinite.
at::Tensor in_series(const at::Tensor& a, const at::Tensor& b) {
  const auto b_is_smaller = b.le(a);
  const auto smaller = at::where(b_is_smaller, b, a), larger = at::where(b_is_smaller, a, b);
  return smaller / (1.0 + smaller / larger);
}
/// a/(a + b) and b/(a + b), in the same way.
std::array<at::Tensor, 2> shares(const at::Tensor& a, const at::Tensor& b) {
  const auto b_is_smaller = b.le(a);
  const auto ratio = at::where(b_is_smaller, b, a) / at::where(b_is_smaller, a, b);
  const auto of_larger = (1.0 + ratio).reciprocal(), of_smaller = ratio * of_larger;
  return {at::where(b_is_smaller, of_larger, of_smaller), at::where(b_is_smaller, of_smaller, of_larger)};
}

/// Summed over the samples where these share one.
at::Tensor like(const at::Tensor& tensor, const at::Tensor& sum) {
  if (tensor.dim() == 0) return total(sum);
  return tensor.size(0) == 1 && sum.size(0) != 1 ? sum.sum(0, /*keepdim=*/true) : sum;
}

/// v w, summed over the channels.
at::Tensor over_channels(const at::Tensor& v, const at::Tensor& w) { return (v * w).sum(1, /*keepdim=*/true); }

/// ∂ mean(a, b)/∂a; 0 in a sample whose κ is not finite, which was refused, so that its λ of 0 gives 0.
at::Tensor derivative_of_mean(FaceMean mean, const at::Tensor& a, const at::Tensor& b) {
  return mean == FaceMean::kHarmonic ? 2.0 * (b / (a + b)).square().nan_to_num(0.0) : at::full_like(a, 0.5);
}

}  // namespace

double DiffusionOperator::inverse_width(int64_t axis) const {
  return static_cast<double>(shape_[axis]) / box_.lengths[axis];
}
double DiffusionOperator::inverse_width2(int64_t axis) const { return inverse_width(axis) * inverse_width(axis); }

std::array<at::Tensor, 2> DiffusionOperator::faces(int64_t axis, double factor) const {
  const int64_t d = 2 + axis;
  const double scale = factor * inverse_width2(axis);
  const bool harmonic = box_.mean == FaceMean::kHarmonic;
  const auto kappa = kappa_along(axis);
  const auto averaged = harmonic ? kappa.reciprocal() : kappa;
  const auto mean = [&](const at::Tensor& a, const at::Tensor& b) {
    return harmonic ? (a + b).reciprocal() * (2.0 * scale) : (a + b) * (0.5 * scale);
  };
  const auto inner = mean(above(averaged, d), below(averaged, d));
  const auto outer = [&](size_t end) -> at::Tensor {
    const auto cells = end == 0 ? first(kappa, d) : last(kappa, d);
    if (box_.sides[axis][end] == Side::kZero) return 2.0 * scale * cells;
    if (box_.sides[axis][end] != Side::kRobin) return at::zeros_like(cells);
    const auto& h = robin(axis, end);
    const auto within = 2.0 * inverse_width2(axis) * cells,
               beyond = inverse_width(axis) * (h.dim() == 0 ? h : or_nan(h, h.ge(0)));
    return factor * in_series(within, beyond);
  };
  const auto around = wraps_around(axis) ? mean(first(averaged, d), last(averaged, d)) : at::Tensor();
  const auto low = around.defined() ? around : outer(0);
  const auto high = around.defined() ? around : outer(1);
  return {joined_along(low, inner, d), joined_along(inner, high, d)};
}

at::Tensor DiffusionOperator::apply(const at::Tensor& v) const {
  auto sum = shift_ * v;
  for (int64_t axis = 0; axis < dim(); ++axis) {
    const int64_t d = v.dim() - dim() + axis;
    const auto [lower, upper] = faces(axis);
    const auto nothing = at::zeros_like(first(v, d));
    const auto before = wraps_around(axis) ? at::roll(v, 1, d) : at::cat({nothing, below(v, d)}, d);
    const auto after = wraps_around(axis) ? at::roll(v, -1, d) : at::cat({above(v, d), nothing}, d);
    sum = sum + lower * (v - before) + upper * (v - after);
  }
  return sum;
}

DiffusionOperator::SideProducts DiffusionOperator::side_product_rule(int64_t axis, size_t end, const at::Tensor& lambda,
                                                                     const at::Tensor& u) const {
  const int64_t d = 2 + axis;
  const auto at_side = [&](const at::Tensor& t) { return end == 0 ? first(t, d) : last(t, d); };
  const auto side = box_.sides[axis][end];
  if (side != Side::kZero && side != Side::kRobin) return {};
  const auto product = inverse_width2(axis) * over_channels(at_side(u), at_side(lambda));
  if (side == Side::kZero) return {2.0 * product, {}};
  // Of within·beyond/(within + beyond), with within = 2κ/w² and beyond = h/w, where w is the width of a cell.
  const auto within = 2.0 * inverse_width2(axis) * at_side(kappa_along(axis)),
             beyond = inverse_width(axis) * robin(axis, end);
  const auto [share_of_within, share_of_beyond] = shares(within, beyond);
  const auto of_within = share_of_beyond.square().nan_to_num(0.0);
  const auto of_beyond = share_of_within.square().nan_to_num(0.0);
  const auto h_bar = like(robin(axis, end), product * of_beyond / inverse_width(axis));
  return {2.0 * product * of_within, h_bar.dim() == 0 ? h_bar : h_bar.squeeze(d).squeeze(1)};
}

void DiffusionOperator::add_rule_of_faces(int64_t axis, const at::Tensor& lambda, const at::Tensor& u,
                                          at::Tensor& kappa_bar) const {
  const int64_t d = 2 + axis;
  const auto kappa = kappa_along(axis);
  // Fields that are zero but at the low, or the high end of the axis.
  const auto at_first = [&](const at::Tensor& t) { return padded(t, d, 0, shape_[axis] - t.size(d)); };
  const auto at_last = [&](const at::Tensor& t) { return padded(t, d, shape_[axis] - t.size(d), 0); };
  const auto inner =
      inverse_width2(axis) * over_channels(above(u, d) - below(u, d), above(lambda, d) - below(lambda, d));
  add_to(kappa_bar, at_last(inner * derivative_of_mean(box_.mean, above(kappa, d), below(kappa, d))));
  add_to(kappa_bar, at_first(inner * derivative_of_mean(box_.mean, below(kappa, d), above(kappa, d))));
  if (!wraps_around(axis)) return;
  const auto around =
      inverse_width2(axis) * over_channels(first(u, d) - last(u, d), first(lambda, d) - last(lambda, d));
  add_to(kappa_bar, at_first(around * derivative_of_mean(box_.mean, first(kappa, d), last(kappa, d))));
  add_to(kappa_bar, at_last(around * derivative_of_mean(box_.mean, last(kappa, d), first(kappa, d))));
}

std::vector<at::Tensor> DiffusionOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  if (auto by_kernel = product_rule_by_kernel(lambda, u); !by_kernel.empty()) return by_kernel;
  const bool on_loops = has_product_rule_loops(lambda, u, kappa_);
  const auto shift_bar = like(shift_, over_channels(lambda, u));
  std::vector<at::Tensor> kappa_bars(per_axis_ ? dim() : 1), robin_bar;
  for (int64_t axis = 0; axis < dim(); ++axis) {
    auto& kappa_bar = kappa_bars[per_axis_ ? axis : 0];
    if (on_loops) add_rule_on_loops(axis, lambda, u, kappa_bar);
    else add_rule_of_faces(axis, lambda, u, kappa_bar);
    for (size_t end = 0; end < 2; ++end) {
      if (on_loops && box_.sides[axis][end] != Side::kRobin) continue;  // done
      const auto sides = side_product_rule(axis, end, lambda, u);
      const auto &of_kappa = sides.of_kappa, &of_h = sides.of_h;
      const int64_t elsewhere = shape_[axis] - 1;
      const auto at_side = [&] {
        return padded(of_kappa, 2 + axis, end == 0 ? 0 : elsewhere, end == 0 ? elsewhere : 0);
      };
      if (of_kappa.defined() && on_loops && kappa_.size(0) == 1)
        kappa_bar.narrow(0, 0, 1).add_(like(kappa_, at_side()));
      else if (of_kappa.defined()) add_to(kappa_bar, at_side());
      if (of_h.defined()) robin_bar.push_back(of_h);
    }
  }
  const auto kappa_bar = per_axis_ ? like(kappa_, at::cat(kappa_bars, 1)) : like(kappa_, kappa_bars[0]).squeeze(1);
  std::vector<at::Tensor> all{kappa_bar, shift_.dim() == 0 ? shift_bar : shift_bar.squeeze(1)};
  all.insert(all.end(), robin_bar.begin(), robin_bar.end());
  return all;
}

at::Tensor DiffusionOperator::coefficients() const {
  // NaN where kappa is not allowed, or not finite, which a harmonic mean would lose.
  auto diagonal = shift_ + 0.0 * (per_axis_ ? kappa_.sum(1, /*keepdim=*/true) : kappa_);
  if (!known_positive_) diagonal = or_nan(diagonal, per_axis_ ? kappa_.gt(0).all(1, /*keepdim=*/true) : kappa_.gt(0));
  std::vector<at::Tensor> all{at::Tensor()};
  for (int64_t axis = 0; axis < dim(); ++axis)
    for (const auto& coupling : faces(axis, -1.0)) {
      diagonal = diagonal - coupling;
      all.push_back(coupling);
    }
  all[0] = diagonal;
  for (auto& field : all) field = field.expand_as(diagonal);
  return at::cat(all, 1);
}

OperatorSpec DiffusionOperator::as_stencil() const {
  std::vector<bool> periodic;
  for (int64_t axis = 0; axis < dim(); ++axis) periodic.push_back(wraps_around(axis));
  return nearest_stencil(coefficients(), shape_, periodic);
}

at::Tensor DiffusionOperator::norm() const { return StencilOperator(as_stencil()).norm(); }

at::Tensor DiffusionOperator::solve_directly(const at::Tensor& b, bool /*transposed*/) const {
  if (!takes_differences() || !b.is_cpu()) return StencilOperator(as_stencil()).solve_directly(b, false);
  auto wide = *this;  // a diagonal in float32 would lose what the loops keep
  wide.kappa_ = kappa_.to(at::kDouble);
  wide.shift_ = shift_.to(at::kDouble);
  return StencilOperator(wide.as_stencil()).solve_directly(b.to(at::kDouble), false).to(b.scalar_type());
}

std::unique_ptr<Operator> DiffusionOperator::select(const at::Tensor& index) const {
  auto chosen = std::make_unique<DiffusionOperator>(*this);
  const auto pick = [&](at::Tensor& t) {
    if (t.dim() > 0 && t.size(0) > 1) t = t.index_select(0, index);
  };
  pick(chosen->kappa_);
  pick(chosen->shift_);
  for (auto& h : chosen->robin_) pick(h);
  return chosen;
}

std::vector<int64_t> DiffusionOperator::vector_shape() const { return with_channels(1, shape_); }

std::shared_ptr<const kernels::Kernels> DiffusionOperator::kernels(const at::Tensor& b, bool /*transposed*/) const {
  const at::NoGradGuard no_grad;
  auto marked = *this;
  marked.shift_ = shift_or_nan();
  const StencilOperator stencil(marked.as_stencil());
  return takes_differences() ? stencil.kernels_by_differences(b, marked.shift_)
                             : stencil.kernels(b, /*transposed=*/false);
}

std::optional<gpu::OperatorView> DiffusionOperator::gpu_view(const at::Tensor& b, bool /*transposed*/) const {
  static_assert(static_cast<int>(Side::kZero) == 0 && static_cast<int>(Side::kPeriodic) == 2 &&
                static_cast<int>(Side::kRobin) == 3);
  std::string sides;
  gpu::OperatorView view;
  using namespace gpu::diffusion_slots;
  view.tensors.resize(gpu::kMostTensors);
  view.numbers.resize(gpu::kMostNumbers);
  // A single number of the host is an argument; one of the device becomes a field.
  const auto take = [&](const at::Tensor& t, at::IntArrayRef field, size_t tensor, size_t number) {
    if (t.dim() == 0 && t.is_cpu()) view.numbers[number] = number_of(t);
    else view.tensors[tensor] = (t.dim() == 0 ? t.expand(field) : t).contiguous();
  };
  view.tensors[kKappa] = kappa_.contiguous();
  auto field = kappa_.sizes().vec();
  field[0] = field[1] = 1;
  take(shift_, field, kShift, kShiftNumber);
  for (size_t axis = 0; axis < 3; ++axis) {
    const int64_t d = static_cast<int64_t>(axis) - 3 + dim();
    for (size_t end = 0; end < 2; ++end) {
      const auto side = d < 0 ? Side::kFlux : box_.sides[d][end];
      sides += ", " + std::to_string(static_cast<int>(side));
      auto on_side = field;
      if (d >= 0) on_side[2 + d] = 1;
      if (side == Side::kRobin) take(robin(d, end), on_side, kRobin + 2 * axis + end, kRobinNumber + 2 * axis + end);
    }
    view.numbers[kInverseWidth + axis] = d < 0 ? 0.0 : inverse_width(d);
  }
  view.type = "Diffusion<" + gpu::type_of(b.scalar_type()) + ", " + gpu::grid_of(shape_) + ", " +
              std::to_string(b.size(1)) + ", " + std::to_string(box_.mean == FaceMean::kHarmonic) + ", " +
              std::to_string(kappa_.size(1)) + sides + ">";
  return view;
}

std::optional<kernels::FactorKey> DiffusionOperator::key(bool /*transposed*/) const {
  kernels::FactorKeyMaker key;
  key.add(int64_t{per_axis_ ? -2 : -1})
      .add(static_cast<int64_t>(box_.mean))
      .add(shape_.data(), dim())
      .add(box_.lengths.data(), dim());
  for (const auto& sides : box_.sides)
    for (const auto side : sides) key.add(static_cast<int64_t>(side));
  for (const auto& [name, t] : tensors()) {
    if (t.dim() > 0 && t.size(0) != 1) return std::nullopt;
    add_numbers(key, t);
  }
  return key.key();
}

}  // namespace prdp
