#include "prdp/solvers/tensor_cycles.h"

#include <ATen/core/grad_mode.h>

#include "prdp/kernels/coarsening.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

/// A number for each sample, to multiply vectors (batch, channel, *shape) with.
at::Tensor for_vectors(const at::Tensor& per_sample, int64_t dim) {
  auto sizes = std::vector<int64_t>(dim + 2, 1);
  sizes[0] = per_sample.size(0);
  return per_sample.view(sizes);
}

std::vector<int> axes_to_coarsen(const TensorStencil& a) {
  std::vector<double> coupling(a.dim());
  std::vector<at::Tensor> sizes;
  for (const auto& entry : a.entries) sizes.push_back(entry.coefficient.abs().sum());
  const auto host = at::stack(sizes).to(at::kCPU, at::kDouble);
  for (size_t e = 0; e < sizes.size(); ++e)
    for (int64_t d = 0; d < a.dim(); ++d)
      if (a.entries[e].offset[d] != 0) coupling[d] += host.const_data_ptr<double>()[e];
  return kernels::axes_to_coarsen(a.shape, coupling);
}

/// p and q of each step, for vectors: over [ρ/4, ρ] with the radius of each sample, to which q is inverse.
std::vector<std::array<at::Tensor, 2>> smoothing_steps(const at::Tensor& radius, int64_t count, int64_t dim) {
  std::vector<std::array<at::Tensor, 2>> steps;
  for (const auto& [p, q] : kernels::smoothing_steps(1.0, count))
    steps.push_back({for_vectors(at::full_like(radius, p), dim), for_vectors(q / radius, dim)});
  return steps;
}

/// Sums of the coefficients with offset -1, 0 and 1 along the axis.
std::array<at::Tensor, 3> sums_along(const TensorStencil& a, int64_t axis) {
  std::array<at::Tensor, 3> sums;
  for (auto& sum : sums) sum = at::zeros_like(a.diagonal());
  for (const auto& [offset, coefficient] : a.entries) {
    auto& sum = sums[offset[axis] + 1];
    sum = sum + coefficient;
  }
  return sums;
}

}  // namespace

TensorCycles::Transfer TensorCycles::make_transfer(const TensorStencil& a, const TensorStencil& transpose,
                                                   int64_t axis) {
  const int64_t n = a.shape[axis], from_end = axis - a.dim();
  const bool periodic = a.periodic[axis];
  Transfer t{from_end, n, kernels::coarse_points(n, periodic), periodic, {}, {}, {}};
  const auto options = a.diagonal().options().dtype(at::kLong);
  const auto places = at::arange(n, options), is_coarse = places.remainder(2).eq(periodic ? 0 : 1);
  const auto between = at::arange(periodic ? 1 : 0, n, 2, options);
  t.order = at::where(is_coarse, places.div(2, "floor"), t.coarse + places.div(2, "floor"));
  const auto own = sums_along(a, axis), of_transpose = sums_along(transpose, axis);
  const auto weight = [&](const at::Tensor& side, const at::Tensor& centre) {
    const auto w = -side / at::where(centre.eq(0), at::ones_like(centre), centre);
    return w.clamp(0.0, 1.0).index_select(from_end, between).unsqueeze(1);
  };
  const auto centre = own[1] + of_transpose[1];
  t.interpolation = {weight(own[0] + of_transpose[0], centre), weight(own[2] + of_transpose[2], centre)};
  t.restriction = {weight(of_transpose[0], of_transpose[1]), weight(of_transpose[2], of_transpose[1])};
  return t;
}

at::Tensor TensorCycles::interpolate(const Transfer& t, const at::Tensor& coarse, bool transposed) {
  const auto& w = transposed ? t.restriction : t.interpolation;
  const int64_t between = t.fine - t.coarse;
  const auto none = at::zeros_like(coarse.narrow(t.axis, 0, 1));
  const auto before = t.periodic ? coarse : at::cat({none, coarse}, t.axis);
  const auto after = t.periodic ? coarse.roll(-1, t.axis) : at::cat({coarse, none}, t.axis);
  const auto made = w.before * before.narrow(t.axis, 0, between) + w.after * after.narrow(t.axis, 0, between);
  return at::cat({coarse, made}, t.axis).index_select(t.axis, t.order);
}

at::Tensor TensorCycles::restrict(const Transfer& t, const at::Tensor& fine, bool transposed) {
  const auto& w = transposed ? t.interpolation : t.restriction;
  const int64_t between = t.fine - t.coarse, first = t.periodic ? 0 : 1;
  const auto coarse = fine.slice(t.axis, first, t.fine, 2), rest = fine.slice(t.axis, 1 - first, t.fine, 2);
  const auto before = w.before * rest, after = w.after * rest;
  const auto none = at::zeros_like(rest.narrow(t.axis, 0, 1));
  if (t.periodic) {
    const bool is_odd = t.coarse > between;  // no point lies between the last and the first
    return coarse +
           (is_odd ? at::cat({before, none}, t.axis) + at::cat({none, after}, t.axis) : before + after.roll(1, t.axis));
  }
  const auto shifted = before.narrow(t.axis, 1, between - 1);
  return coarse + (t.coarse == between ? at::cat({shifted, none}, t.axis) : shifted) +
         after.narrow(t.axis, 0, t.coarse);
}

TensorCycles::TensorCycles(const Operator& a, bool of_transpose, int64_t smoothing, const at::Tensor& b) {
  const at::NoGradGuard no_grad;
  const auto norm = a.norm();
  const int64_t batch = norm.dim() == 0 ? 1 : norm.size(0), channels = b.size(1);
  const auto product = [&](const at::Tensor& v) {
    auto sizes = v.sizes().vec();
    sizes[1] = channels;
    const auto wide = v.expand(sizes);
    return (of_transpose ? a.apply_transpose(wide) : a.apply(wide)).narrow(1, 0, 1).detach();
  };
  auto stencil = probe(product, batch, b.sizes().slice(2).vec(), b.options());
  for (;;) {
    auto& level = levels_.emplace_back();
    level.a = stencil;
    level.transpose = stencil.transposed();
    auto sizes = at::zeros_like(stencil.diagonal());
    for (const auto& entry : stencil.entries) sizes = sizes + entry.coefficient.abs();
    const auto radius = (sizes / stencil.diagonal().abs()).flatten(1).amax(1);
    level.inverse_diagonal = stencil.diagonal().reciprocal().unsqueeze(1);
    level.steps = smoothing_steps(radius, smoothing, stencil.dim());
    const auto axes = axes_to_coarsen(stencil);
    if (axes.empty()) break;
    for (const auto axis : axes) {
      const auto transfer =
          make_transfer(stencil, axis == axes.front() ? levels_.back().transpose : stencil.transposed(), axis);
      auto shape = stencil.shape;
      shape[axis] = transfer.coarse;
      const auto galerkin = [&](const at::Tensor& v) {
        return restrict(transfer, stencil.apply(interpolate(transfer, v, false)), false);
      };
      auto coarse = probe(galerkin, stencil.diagonal().size(0), shape, b.options(), &stencil.periodic);
      stencil = std::move(coarse);
      levels_.back().transfers.push_back(transfer);
    }
  }
  const auto& last = levels_.back().a;
  const int64_t n = last.diagonal().numel() / last.diagonal().size(0);
  auto unit = last.shape;
  unit.insert(unit.begin(), {1, n});
  const auto columns = last.apply(at::eye(n, b.options()).view(unit)).flatten(2).mT();
  const double tiny = 10.0 * static_cast<double>(n) * epsilon_of(b);
  coarsest_inverse_ = at::linalg_pinv(columns.to(at::kDouble).nan_to_num(0.0, 0.0, 0.0), tiny).to(b.scalar_type());
}

at::Tensor TensorCycles::cycle(size_t l, const at::Tensor& b, bool transposed) const {
  const auto& level = levels_[l];
  if (level.transfers.empty()) {
    const auto inverse = transposed ? coarsest_inverse_.mT() : coarsest_inverse_;
    return at::matmul(b.flatten(2), inverse.mT()).view_as(b);
  }
  const auto& a = transposed ? level.transpose : level.a;
  const auto smooth = [&](at::Tensor x, at::Tensor before, size_t first) {
    for (size_t s = first; s < level.steps.size(); ++s) {
      const auto& [p, q] = level.steps[s];
      const auto next = x + p * (x - before) + q * level.inverse_diagonal * (b - a.apply(x));
      before = std::exchange(x, next);
    }
    return x;
  };
  const auto start = level.steps[0][1] * level.inverse_diagonal * b;
  auto x = smooth(start, at::zeros_like(start), 1);
  auto r = b - a.apply(x);
  for (const auto& t : level.transfers) r = restrict(t, r, transposed);
  auto correction = cycle(l + 1, r, transposed);
  for (auto t = level.transfers.rbegin(); t != level.transfers.rend(); ++t)
    correction = interpolate(*t, correction, transposed);
  x = x + correction;
  return smooth(x, x, 0);
}

}  // namespace prdp
