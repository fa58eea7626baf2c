#include "prdp/operators/diffusion_operator.h"

#include <ATen/TensorSubclassLikeUtils.h>
#include <ATen/core/grad_mode.h>

#include <cmath>
#include <sstream>

#include "prdp/gpu/operator_view.h"
#include "prdp/operators/products_by_kernel.h"
#include "prdp/operators/stencil_operator.h"
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

/// t with so many zeros before and behind it along an axis.
at::Tensor padded(const at::Tensor& t, int64_t axis, int64_t before, int64_t behind) {
  std::vector<int64_t> pad(2 * (t.dim() - axis), 0);
  pad[pad.size() - 2] = before;
  pad[pad.size() - 1] = behind;
  return at::constant_pad_nd(t, pad);
}

/// a and b behind each other, where either may be the same for all samples.
at::Tensor joined(const at::Tensor& a, const at::Tensor& b, int64_t axis) {
  if (a.sym_size(0) == b.sym_size(0)) return at::cat({a, b}, axis);
  const auto grown = [batch = a.size(0) == 1 ? b.size(0) : a.size(0)](const at::Tensor& t) {
    auto sizes = t.sizes().vec();
    sizes[0] = batch;
    return t.expand(sizes);
  };
  return at::cat({grown(a), grown(b)}, axis);
}

/// The least mean of a sample.
double mean_of_least_sample(const at::Tensor& t) {
  return t.dim() == 0 ? t.item<double>() : t.to(at::kDouble).flatten(1).mean(1).min().item<double>();
}

template <class T>
bool launch_products(gpu::DiffusionProducts<T> of, const at::Tensor& lambda, const at::Tensor& u,
                     const at::Tensor& kappa, const at::Tensor& out) {
  of.pair = pair_of<T>(lambda, u, out.size(0));
  of.kappa = kappa.const_data_ptr<T>();
  of.out = out.mutable_data_ptr<T>();
  return gpu::each_point(out.device(), product_body<T>("DiffusionProducts"), of, out.numel());
}

/// Summed over the samples where these share one.
at::Tensor like(const at::Tensor& tensor, const at::Tensor& sum) {
  if (tensor.dim() == 0) return total(sum);
  return tensor.size(0) == 1 && sum.size(0) != 1 ? sum.sum(0, /*keepdim=*/true) : sum;
}

}  // namespace

OperatorSpec diffusion(const at::Tensor& kappa, const at::Tensor& shift, const std::vector<std::array<Side, 2>>& sides,
                       const std::vector<double>& lengths, FaceMean faces, const std::vector<at::Tensor>& robin) {
  TORCH_CHECK_VALUE(kappa.dim() >= 2 && kappa.dim() <= 4,
                    "Diffusion: kappa must have shape (batch or 1, *shape) with 1 to 3 axes in shape, got ",
                    kappa.sizes());
  const auto dim = static_cast<size_t>(kappa.dim() - 1);
  TORCH_CHECK_VALUE(sides.size() == 1 || sides.size() == dim, "Diffusion: boundary must be one for all axes or ", dim,
                    ", one for each, got ", sides.size());
  TORCH_CHECK_VALUE(lengths.size() == 1 || lengths.size() == dim, "Diffusion: length must be one number or ", dim,
                    ", one for each axis, got ", lengths.size());
  OperatorSpec spec{"diffusion", kappa.sizes().slice(1).vec(), {}, {kappa, shift}};
  spec.tensors.insert(spec.tensors.end(), robin.begin(), robin.end());
  for (size_t d = 0; d < dim; ++d)
    for (const auto side : sides[sides.size() == 1 ? 0 : d]) spec.parameters.push_back(static_cast<double>(side));
  for (size_t d = 0; d < dim; ++d) spec.parameters.push_back(lengths[lengths.size() == 1 ? 0 : d]);
  spec.parameters.push_back(static_cast<double>(faces));
  [[maybe_unused]] const DiffusionOperator checks_the_rest(spec);
  bool held = shift.dim() > 0 || shift.item<double>() != 0.0;
  for (const auto& axis : sides)
    for (const auto side : axis) held = held || side == Side::kZero || side == Side::kRobin;
  if (held) return spec;
  spec.kind = "singular_diffusion";
  for (int side = 0; side < 2; ++side) spec.tensors.push_back(at::empty({0}, kappa.options()));
  return spec;
}

DiffusionOperator::DiffusionOperator(const OperatorSpec& spec) : shape_(spec.shape) {
  TORCH_CHECK_VALUE(spec.tensors.size() >= 2, "Diffusion: takes the tensors kappa, shift, and h of each Robin side");
  const auto &kappa = spec.tensors[0], &shift = spec.tensors[1];
  TORCH_CHECK_VALUE(dim() >= 1 && dim() <= 3 && kappa.dim() == dim() + 1 &&
                        kappa.sym_sizes().slice(1) == c10::SymIntArrayRef(c10::fromIntArrayRefSlow(shape_)),
                    "Diffusion: kappa must have shape (batch or 1, *shape), got ", kappa.sym_sizes());
  TORCH_CHECK_TYPE(kappa.scalar_type() == at::kFloat || kappa.scalar_type() == at::kDouble,
                   "Diffusion: kappa must be float32 or float64, got ", kappa.scalar_type());
  TORCH_CHECK_VALUE(
      shift.dim() == 0 || (shift.dim() == kappa.dim() && shift.sym_sizes().slice(1) == kappa.sym_sizes().slice(1)),
      "Diffusion: shift must be a number or have the shape of kappa, got ", shift.sym_sizes());
  kappa_ = kappa.unsqueeze(1);
  shift_ = shift.to(kappa.scalar_type());
  if (shift.dim() > 0) shift_ = shift_.unsqueeze(1);
  const auto axes = static_cast<size_t>(dim());
  TORCH_CHECK_VALUE(spec.parameters.size() == 3 * axes + 1, "Diffusion: expected ", 3 * axes + 1, " parameters, got ",
                    spec.parameters.size());
  for (size_t d = 0; d < axes; ++d) {
    sides_.push_back({static_cast<Side>(static_cast<int>(spec.parameters[2 * d])),
                      static_cast<Side>(static_cast<int>(spec.parameters[2 * d + 1]))});
    TORCH_CHECK_VALUE((sides_[d][0] == Side::kPeriodic) == (sides_[d][1] == Side::kPeriodic),
                      "Diffusion: both sides of an axis are periodic or none is");
    lengths_.push_back(spec.parameters[2 * axes + d]);
    TORCH_CHECK_VALUE(std::isfinite(lengths_[d]) && lengths_[d] > 0.0, "Diffusion: length must be > 0, got ",
                      lengths_[d]);
  }
  mean_ = static_cast<FaceMean>(static_cast<int>(spec.parameters.back()));
  for (int64_t axis = 0; axis < dim(); ++axis)
    for (size_t end = 0; end < 2; ++end)
      if (sides_[axis][end] == Side::kRobin) take_robin(spec.tensors, axis, end);
  TORCH_CHECK_VALUE(spec.tensors.size() == 2 + robin_.size(), "Diffusion: takes h of each Robin side, ", robin_.size(),
                    " here, got ", spec.tensors.size() - 2);
}

void DiffusionOperator::take_robin(const std::vector<at::Tensor>& tensors, int64_t axis, size_t end) {
  TORCH_CHECK_VALUE(2 + robin_.size() < tensors.size(), "Diffusion: takes h of each Robin side, got ",
                    tensors.size() - 2);
  const auto& h = tensors[2 + robin_.size()];
  auto side = shape_;
  side.erase(side.begin() + axis);
  const auto whole = c10::fromIntArrayRefSlow(side);
  TORCH_CHECK_VALUE(h.dim() == 0 || (h.dim() == dim() && h.sym_sizes().slice(1) == c10::SymIntArrayRef(whole)),
                    "Diffusion: h of the ", end == 0 ? "low" : "high", " side of axis ", axis,
                    " must be a number or have shape (batch or 1, *side), where side is ", at::IntArrayRef(side),
                    ", got ", h.sym_sizes());
  const auto taken = h.to(kappa_.scalar_type());
  robin_.push_back(h.dim() == 0 ? taken : taken.unsqueeze(1 + axis).unsqueeze(1));
}

const at::Tensor& DiffusionOperator::robin(int64_t axis, size_t end) const {
  size_t before = 0;
  for (int64_t d = 0; d < dim(); ++d)
    for (size_t e = 0; e < 2; ++e) {
      if (d == axis && e == end) return robin_[before];
      before += sides_[d][e] == Side::kRobin;
    }
  TORCH_INTERNAL_ASSERT(false);
}

std::vector<std::pair<const char*, at::Tensor>> DiffusionOperator::tensors() const {
  std::vector<std::pair<const char*, at::Tensor>> all{{"kappa", kappa_}, {"shift", shift_}};
  for (const auto& h : robin_) all.emplace_back("h of a Robin side", h);
  return all;
}

void DiffusionOperator::check_vector(const at::Tensor& b) const {
  TORCH_CHECK_VALUE(b.dim() == dim() + 2 && b.sym_sizes().slice(2) == kappa_.sym_sizes().slice(2) && b.sym_size(1) != 0,
                    "Diffusion: expected kappa (batch or 1, *shape) and b (batch, channel, *shape), got kappa ",
                    kappa_.squeeze(1).sym_sizes(), " and b ", b.sym_sizes());
  for (const auto& [name, t] : tensors())
    TORCH_CHECK_VALUE(t.dim() == 0 || t.sym_size(0) == 1 || t.sym_size(0) == b.sym_size(0), "Diffusion: ", name,
                      " holds ", t.sym_size(0), " samples, the vector holds ", b.sym_size(0));
  TORCH_CHECK_TYPE(b.scalar_type() == kappa_.scalar_type(), "Diffusion: kappa is ", kappa_.scalar_type(),
                   " but the vector is ", b.scalar_type());
  for (const auto& [name, t] : tensors())
    TORCH_CHECK_VALUE(t.device() == b.device() || (t.dim() == 0 && t.is_cpu()), "Diffusion: its tensors are on ",
                      t.device(), " but the vector is on ", b.device());
}

void DiffusionOperator::check_parameters(bool kernel_checks) const {
  for (const auto& [name, t] : tensors())
    if (at::isTensorSubclassLike(t) || t.is_meta() || t.numel() == 0) return;  // no numbers, or none yet
  for (const auto& h : robin_) {
    if (kernel_checks && (h.dim() > 0 || !h.is_cpu())) continue;
    const double least = h.min().item<double>();
    TORCH_CHECK_VALUE(!(least < 0.0) && (h.dim() > 0 || std::isfinite(least)),
                      "Diffusion: h of a Robin side must be finite and >= 0, got ", least);
  }
  if (kernel_checks) return;
  const auto [low, high] = at::aminmax(kappa_);
  const auto ends = at::stack({low, high}).to(at::kCPU, at::kDouble);
  const auto* least_and_most = ends.const_data_ptr<double>();
  if (least_and_most[0] > 0.0) return warn_if_rounding_holds(least_and_most[0], least_and_most[1]);
  const auto wrong = kappa_.le(0);
  if (!wrong.any().item<bool>()) return;
  const auto index = first_true(wrong);
  TORCH_CHECK_VALUE(false, "Diffusion: kappa must be > 0, got ",
                    kappa_.flatten()[wrong.flatten().to(at::kByte).argmax().item<int64_t>()].item<double>(),
                    " in sample ", index[0], " at index ", at::IntArrayRef(index).slice(2));
}

void DiffusionOperator::warn_if_rounding_holds(double least_kappa, double largest_kappa) const {
  if (kappa_.scalar_type() != at::kFloat || !kappa_.is_cpu() || !shift_.is_cpu()) return;
  double diagonal = 0.0;
  for (int64_t axis = 0; axis < dim(); ++axis) diagonal += 2.0 * largest_kappa * per_cell2(axis);
  const double rounding = 10.0 * epsilon_of(kappa_) * diagonal;
  const double least_shift = shift_.min().item<double>();
  warn_of_drift(least_shift, epsilon_of(kappa_) * diagonal);
  if (!std::isfinite(diagonal) || rounding <= held_by(least_shift, least_shift, least_kappa)) return;
  const double shift = mean_of_least_sample(shift_);
  const double held = held_by(shift, least_shift, std::exp(kappa_.log().mean().item<double>()));
  if (!(held > 0.0) || rounding <= held) return;
  std::ostringstream what;
  if (held == shift) what << "a shift of " << shift;
  else what << "what holds u, a shift and sides that act as one of about " << held << ',';
  TORCH_WARN_ONCE("Diffusion: in float32, ", what.str(), " is lost in the rounding of a diagonal of up to ", diagonal,
                  ", so that u may be off by per cents and its mean is not conserved; take float64");
}

void DiffusionOperator::warn_of_drift(double shift, double rounding) const {
  constexpr double most = 1e-4;  // half a per cent in fifty steps
  for (const auto& [low, high] : sides_)
    for (const auto side : {low, high})
      if (side == Side::kZero || side == Side::kRobin) return;
  const double drift = rounding / (2.0 * shift);
  if (std::isfinite(drift) && shift > 0.0 && drift > most)
    TORCH_WARN_ONCE("Diffusion: in float32 the mean of u, which nothing but the shift holds, may drift by up to ",
                    drift, " of itself in each solve, as a shift of ", shift,
                    " is small beside the diagonal; take float64, or more than one step to the same time");
}

double DiffusionOperator::held_by(double shift, double least_shift, double kappa) const {
  double by_sides = 0.0, through_cells = 0.0;
  for (int64_t axis = 0; axis < dim(); ++axis) {
    through_cells += 8.0 * kappa / (lengths_[axis] * lengths_[axis]);
    for (size_t end = 0; end < 2; ++end) {
      const auto side = sides_[axis][end];
      if (side != Side::kZero && side != Side::kRobin) continue;
      const double within = 2.0 * kappa * per_cell(axis);
      const double beyond = side == Side::kRobin ? mean_of_least_sample(robin(axis, end)) : 0.0;
      by_sides += (side == Side::kZero ? within : within * beyond / (within + beyond)) / lengths_[axis];
    }
  }
  const double at_some_cells = shift - least_shift + by_sides;
  return least_shift + at_some_cells / (1.0 + at_some_cells / through_cells);
}

double DiffusionOperator::per_cell(int64_t axis) const { return static_cast<double>(shape_[axis]) / lengths_[axis]; }
double DiffusionOperator::per_cell2(int64_t axis) const { return per_cell(axis) * per_cell(axis); }

std::array<at::Tensor, 2> DiffusionOperator::faces(int64_t axis, double factor) const {
  const int64_t d = 2 + axis;
  const double scale = factor * per_cell2(axis);
  const bool harmonic = mean_ == FaceMean::kHarmonic;
  const auto averaged = harmonic ? kappa_.reciprocal() : kappa_;
  const auto mean = [&](const at::Tensor& a, const at::Tensor& b) {
    return harmonic ? (a + b).reciprocal() * (2.0 * scale) : (a + b) * (0.5 * scale);
  };
  const auto inner = mean(above(averaged, d), below(averaged, d));
  const auto outer = [&](size_t end) -> at::Tensor {
    const auto cells = end == 0 ? first(kappa_, d) : last(kappa_, d);
    if (sides_[axis][end] == Side::kZero) return 2.0 * scale * cells;
    if (sides_[axis][end] != Side::kRobin) return at::zeros_like(cells);
    const auto within = 2.0 * per_cell2(axis) * cells, beyond = per_cell(axis) * robin(axis, end);
    return factor * (within * (beyond / (within + beyond)));  // in series
  };
  const auto around = is_closed(axis) ? mean(first(averaged, d), last(averaged, d)) : at::Tensor();
  const auto low = around.defined() ? around : outer(0);
  const auto high = around.defined() ? around : outer(1);
  return {joined(low, inner, d), joined(inner, high, d)};
}

at::Tensor DiffusionOperator::apply(const at::Tensor& v) const {
  auto sum = shift_ * v;
  for (int64_t axis = 0; axis < dim(); ++axis) {
    const int64_t d = v.dim() - dim() + axis;
    const auto [lower, upper] = faces(axis);
    const auto nothing = at::zeros_like(first(v, d));
    const auto before = is_closed(axis) ? at::roll(v, 1, d) : at::cat({nothing, below(v, d)}, d);
    const auto after = is_closed(axis) ? at::roll(v, -1, d) : at::cat({above(v, d), nothing}, d);
    sum = sum + lower * (v - before) + upper * (v - after);
  }
  return sum;
}

at::Tensor DiffusionOperator::kappa_bar_by_kernel(const at::Tensor& lambda, const at::Tensor& u) const {
  if (!robin_.empty() || !has_product_kernel(lambda, u)) return {};
  const auto fill = [&](auto of) {
    for (int64_t d = 0; d < 3; ++d) of.n[d] = 1;
    for (int64_t d = 0; d < dim(); ++d) {
      const int64_t axis = d + 3 - dim();
      of.n[axis] = static_cast<int>(shape_[d]);
      of.periodic[axis] = is_closed(d);
      for (size_t end = 0; end < 2; ++end)
        of.zero[2 * axis + static_cast<int64_t>(end)] = sides_[d][end] == Side::kZero;
      of.per_cell[axis] = per_cell(d);
    }
    of.harmonic = mean_ == FaceMean::kHarmonic;
    return of;
  };
  const auto kappa = kappa_.detach().contiguous(), out = at::empty_like(kappa);
  const auto l = lambda.contiguous(), v = u.contiguous();
  const bool launched = out.scalar_type() == at::kFloat
                            ? launch_products(fill(gpu::DiffusionProducts<float>{}), l, v, kappa, out)
                            : launch_products(fill(gpu::DiffusionProducts<double>{}), l, v, kappa, out);
  return launched ? out : at::Tensor();
}

std::vector<at::Tensor> DiffusionOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  const auto shift_bar = [&] {
    const auto bar = like(shift_, (lambda * u).sum(1, /*keepdim=*/true));
    return shift_.dim() == 0 ? bar : bar.squeeze(1);
  };
  if (const auto by_kernel = kappa_bar_by_kernel(lambda, u); by_kernel.defined())
    return {by_kernel.squeeze(1), shift_bar()};
  at::Tensor kappa_bar;
  std::vector<at::Tensor> robin_bar;
  for (int64_t axis = 0; axis < dim(); ++axis) {
    const int64_t d = 2 + axis;
    const double scale = per_cell2(axis);
    // ∂ mean(a, b)/∂a; 0 in a sample whose κ is not finite, which was refused, so that its λ of 0 gives 0.
    const auto derivative = [&](const at::Tensor& a, const at::Tensor& b) {
      return mean_ == FaceMean::kHarmonic ? 2.0 * (b / (a + b)).square().nan_to_num(0.0) : at::full_like(a, 0.5);
    };
    const auto couple = [&](const at::Tensor& du, const at::Tensor& dl) {
      return scale * (du * dl).sum(1, /*keepdim=*/true);
    };
    const auto inner = couple(above(u, d) - below(u, d), above(lambda, d) - below(lambda, d));
    const auto lower = below(kappa_, d), upper = above(kappa_, d);
    // Fields that are zero but at the low, or the high end of the axis.
    const auto at_first = [&](const at::Tensor& t) { return padded(t, d, 0, shape_[axis] - t.size(d)); };
    const auto at_last = [&](const at::Tensor& t) { return padded(t, d, shape_[axis] - t.size(d), 0); };
    add_to(kappa_bar, at_last(inner * derivative(upper, lower)));
    add_to(kappa_bar, at_first(inner * derivative(lower, upper)));
    if (is_closed(axis)) {
      const auto around = couple(first(u, d) - last(u, d), first(lambda, d) - last(lambda, d));
      add_to(kappa_bar, at_first(around * derivative(first(kappa_, d), last(kappa_, d))));
      add_to(kappa_bar, at_last(around * derivative(last(kappa_, d), first(kappa_, d))));
    }
    for (size_t end = 0; end < 2; ++end) {
      const auto at_side = [&](const at::Tensor& t) { return end == 0 ? first(t, d) : last(t, d); };
      const auto at_end = [&](const at::Tensor& t) { return end == 0 ? at_first(t) : at_last(t); };
      if (sides_[axis][end] == Side::kZero) add_to(kappa_bar, at_end(2.0 * couple(at_side(u), at_side(lambda))));
      if (sides_[axis][end] != Side::kRobin) continue;
      // Of within·beyond/(within + beyond), with within = 2κ/h² and beyond = h of the side over the width of a cell.
      const auto within = 2.0 * scale * at_side(kappa_), beyond = per_cell(axis) * robin(axis, end);
      const auto of_within = (beyond / (within + beyond)).square().nan_to_num(0.0);
      const auto of_beyond = (within / (within + beyond)).square().nan_to_num(0.0);
      const auto product = couple(at_side(u), at_side(lambda));
      add_to(kappa_bar, at_end(2.0 * product * of_within));
      const auto h_bar = like(robin(axis, end), product * of_beyond / per_cell(axis));
      robin_bar.push_back(h_bar.dim() == 0 ? h_bar : h_bar.squeeze(d).squeeze(1));
    }
  }
  std::vector<at::Tensor> all{like(kappa_, kappa_bar).squeeze(1), shift_bar()};
  all.insert(all.end(), robin_bar.begin(), robin_bar.end());
  return all;
}

at::Tensor DiffusionOperator::coefficients() const {
  auto diagonal = shift_ + 0.0 * kappa_;  // NaN where kappa is not finite, which a harmonic mean would lose
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
  for (int64_t axis = 0; axis < dim(); ++axis) periodic.push_back(is_closed(axis));
  return nearest_stencil(coefficients(), shape_, periodic);
}

at::Tensor DiffusionOperator::norm() const { return StencilOperator(as_stencil()).norm(); }

at::Tensor DiffusionOperator::solve_directly(const at::Tensor& b) const {
  return StencilOperator(as_stencil()).solve_directly(b);
}

std::vector<int64_t> DiffusionOperator::first_nonfinite(int64_t sample) const {
  for (const auto& [name, t] : tensors()) {
    if (t.dim() == 0) continue;
    const auto of_sample = nonfinite(t.select(0, t.size(0) == 1 ? 0 : sample).select(0, 0));
    if (of_sample.any().item<bool>()) return first_true(of_sample);
  }
  return {};
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

std::vector<int64_t> DiffusionOperator::vector_shape() const {
  std::vector<int64_t> shape{1};
  shape.insert(shape.end(), shape_.begin(), shape_.end());
  return shape;
}

std::shared_ptr<const kernels::Kernels> DiffusionOperator::kernels(const at::Tensor& b, bool /*transposed*/) const {
  const at::NoGradGuard no_grad;
  return StencilOperator(as_stencil()).kernels(b, /*transposed=*/false);
}

std::optional<gpu::OperatorView> DiffusionOperator::gpu_view(const at::Tensor& b, bool /*transposed*/) const {
  static_assert(static_cast<int>(Side::kZero) == 0 && static_cast<int>(Side::kPeriodic) == 2 &&
                static_cast<int>(Side::kRobin) == 3);
  std::string sides;
  gpu::OperatorView view;
  view.tensors.resize(8);
  view.numbers.resize(10);
  // A single number of the host is an argument; one of the device becomes a field.
  const auto take = [&](const at::Tensor& t, at::IntArrayRef field, size_t tensor, size_t number) {
    if (t.dim() == 0 && t.is_cpu()) view.numbers[number] = t.item<double>();
    else view.tensors[tensor] = (t.dim() == 0 ? t.detach().expand(field) : t.detach()).contiguous();
  };
  view.tensors[0] = kappa_.detach().contiguous();
  auto field = kappa_.sizes().vec();
  field[0] = 1;
  take(shift_, field, 1, 0);
  for (size_t axis = 0; axis < 3; ++axis) {
    const int64_t d = static_cast<int64_t>(axis) - 3 + dim();
    for (size_t end = 0; end < 2; ++end) {
      const auto side = d < 0 ? Side::kFlux : sides_[d][end];
      sides += ", " + std::to_string(static_cast<int>(side));
      auto on_side = field;
      if (d >= 0) on_side[2 + d] = 1;
      if (side == Side::kRobin) take(robin(d, end), on_side, 2 + 2 * axis + end, 4 + 2 * axis + end);
    }
    view.numbers[1 + axis] = d < 0 ? 0.0 : per_cell(d);
  }
  view.type = "Diffusion<" + gpu::type_of(b.scalar_type()) + ", " + gpu::grid_of(shape_) + ", " +
              std::to_string(b.size(1)) + ", " + std::to_string(mean_ == FaceMean::kHarmonic) + sides + ">";
  return view;
}

std::optional<kernels::FactorKey> DiffusionOperator::key(bool /*transposed*/) const {
  kernels::FactorKeyMaker key;
  key.add(int64_t{-1}).add(static_cast<int64_t>(mean_)).add(shape_.data(), dim()).add(lengths_.data(), dim());
  for (const auto& sides : sides_)
    for (const auto side : sides) key.add(static_cast<int64_t>(side));
  for (const auto& [name, t] : tensors()) {
    if (t.dim() > 0 && t.size(0) != 1) return std::nullopt;
    add_numbers(key, t);
  }
  return key.key();
}

}  // namespace prdp
