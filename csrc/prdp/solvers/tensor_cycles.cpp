#include "prdp/solvers/tensor_cycles.h"

#include <ATen/core/grad_mode.h>

#include "prdp/kernels/coarsening.h"
#include "prdp/kernels/factor_cache.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

/// One look at the device.
kernels::Axes axes_to_coarsen(const TensorStencil& a, const at::Tensor& magnitudes) {
  const int dim = static_cast<int>(a.dim());
  const auto entries = static_cast<int64_t>(a.entries.size());
  auto sums = magnitudes;
  const bool all_couplings = kernels::may_need_one_point(a.shape, dim);
  if (all_couplings) {
    std::vector<at::Tensor> more{a.coefficients().sum(0)};  // what reaches beyond the grid is zero
    for (int d = 0; d < dim; ++d)
      for (const int64_t step : {-1, 1}) {
        auto net = at::zeros_like(a.diagonal());
        for (const auto& [offset, coefficient] : a.entries)
          if (offset[d] == step) net = net + coefficient;
        more.push_back(net);
      }
    sums = at::cat({sums, at::stack(more).abs()});
  }
  const auto host = sums.flatten(1).sum(1).to(at::kCPU, at::kDouble);
  const double* number = host.const_data_ptr<double>();
  kernels::Couplings couplings;
  for (int64_t e = 0; e < entries; ++e)
    for (int d = 0; d < dim; ++d)
      if (a.entries[e].offset[d] != 0) couplings.along[d] += number[e];
  if (all_couplings) {
    couplings.rows = number[entries];
    for (int d = 0; d < dim; ++d) couplings.net[d] = number[entries + 1 + 2 * d] + number[entries + 2 + 2 * d];
  }
  return kernels::axes_to_coarsen(a.shape, dim, couplings);
}

/// See kernels::kVanishing.
void keep_vanishing_diagonal(TensorStencil& coarse, const at::Tensor& fine) {
  auto& own = coarse.entries[0].coefficient;
  auto tiny = fine.abs() * (kernels::kVanishingAlone * epsilon_of(fine));
  if (const auto others = static_cast<int64_t>(coarse.entries.size()) - 1; others > 0) {
    const auto has_neighbours = coarse.coefficients().narrow(0, 1, others).any(0);
    tiny = at::where(has_neighbours, tiny * (kernels::kVanishing / kernels::kVanishingAlone), tiny);
  }
  own = at::where(own.abs() <= tiny, fine, own);
}

/// A v, or Aᵀ v, for v (batch, 1, *shape) that every channel takes; its first channel.
at::Tensor product(const Operator& a, bool of_transpose, int64_t channels, const at::Tensor& v) {
  auto sizes = v.sizes().vec();
  sizes[1] = channels;
  const auto wide = v.expand(sizes);
  return (of_transpose ? a.apply_transpose(wide) : a.apply(wide)).narrow(1, 0, 1).detach();
}

int64_t batch_of(const Operator& a) {
  const auto norm = a.norm();
  return norm.dim() == 0 ? 1 : norm.size(0);
}

/// Sums of the bits of a tensor, each times a number that belongs to its place.
at::Tensor fingerprint(const at::Tensor& t) {
  const auto bits = t.contiguous().view(t.scalar_type() == at::kFloat ? at::kInt : at::kLong).flatten().to(at::kLong);
  auto places = at::arange(1, bits.numel() + 1, bits.options()) * 0x1e3779b97f4a7c15;
  places = places.bitwise_xor(places.bitwise_right_shift(29)) * 0x3f58476d1ce4e5b9;
  return at::stack({(bits * places).sum(), (bits.bitwise_xor(places) * places).sum()});
}

/// Tells A by its product with a vector that has no pattern.
kernels::FactorKey key_of(const Operator& a, bool of_transpose, int64_t smoothing, const at::Tensor& b) {
  const auto shape = b.sizes().slice(2);
  auto sizes = shape.vec();
  sizes.insert(sizes.begin(), {batch_of(a), 1});
  const auto places = at::arange(b[0][0].numel(), b.options().dtype(at::kDouble));
  const auto v = places.square().sin().to(b.scalar_type()).view(shape).expand(sizes);
  const auto told = fingerprint(product(a, of_transpose, b.size(1), v)).to(at::kCPU);
  return kernels::FactorKeyMaker()
      .add(told.const_data_ptr<int64_t>(), 2)
      .add(sizes.data(), static_cast<int64_t>(sizes.size()))
      .add(smoothing)
      .add(static_cast<int64_t>(b.scalar_type()))
      .add(static_cast<int64_t>(b.device().index()))
      .add(static_cast<int64_t>(b.device().type()))
      .key();
}

}  // namespace

std::shared_ptr<const TensorCycles> TensorCycles::find_or_make(const Operator& a, bool of_transpose, int64_t smoothing,
                                                               const at::Tensor& b) {
  const at::NoGradGuard no_grad;
  return factor_cache::find_or_make<TensorCycles>(key_of(a, of_transpose, smoothing, b), [&] {
    return std::make_shared<TensorCycles>(a, of_transpose, smoothing, b);
  });
}

TensorCycles::TensorCycles(const Operator& a, bool of_transpose, int64_t smoothing, const at::Tensor& b) {
  const at::NoGradGuard no_grad;
  const auto apply = [&](const at::Tensor& v) { return product(a, of_transpose, b.size(1), v); };
  auto stencil = probe(apply, batch_of(a), b.sizes().slice(2).vec(), b.options());
  for (;;) {
    auto& level = levels_.emplace_back();
    level.a = stencil;
    level.transpose = stencil.transposed();
    const auto magnitudes = stencil.coefficients().abs();
    // The radius of each sample, to which q is inverse.
    const auto ratios = magnitudes.sum(0) / magnitudes.select(0, 0);
    const auto radius = per_sample(ratios.flatten(1).amax(1), ratios),
               per_radius = (radius * stencil.diagonal()).reciprocal();
    kernels::SmoothingSteps steps(1.0);
    for (int64_t s = 0; s < smoothing; ++s) {
      const auto [p, q] = steps.next();
      level.steps.push_back({p, (q * per_radius).unsqueeze(1)});
    }
    const auto axes = axes_to_coarsen(stencil, magnitudes);
    if (axes.empty()) break;
    auto fine = stencil.diagonal();
    for (const auto axis : axes) {
      const auto& transfer =
          level.transfers.emplace_back(stencil, axis == axes.front() ? level.transpose : stencil.transposed(), axis);
      stencil = transfer.coarse_operator(stencil);
      fine = transfer.at_coarse(fine);
    }
    keep_vanishing_diagonal(stencil, fine);
  }
  const auto& last = levels_.back().a;
  const int64_t n = last.diagonal().numel() / last.diagonal().size(0);
  auto unit = last.shape;
  unit.insert(unit.begin(), {1, n});
  const auto columns = last.apply(at::eye(n, b.options()).view(unit)).flatten(2).mT();
  const double tiny = 10.0 * static_cast<double>(n) * epsilon_of(b);
  // What is tiny may only be so beside a larger diagonal: it is brought to the order of one.
  const auto coarsest = columns.to(at::kDouble).nan_to_num(0.0, 0.0, 0.0);
  const auto diagonal = coarsest.diagonal(0, -2, -1);
  const auto d = at::where(diagonal.eq(0), 1.0, diagonal.abs()).log2().div(-2.0).round().exp2();
  const auto scales = d.unsqueeze(-1) * d.unsqueeze(-2);
  coarsest_inverse_ = (scales * at::linalg_pinv(scales * coarsest, tiny)).to(b.scalar_type());
}

int64_t TensorCycles::bytes() const {
  auto sum = static_cast<int64_t>(coarsest_inverse_.nbytes());
  for (const auto& level : levels_) {
    const auto field = static_cast<int64_t>(level.a.diagonal().nbytes());
    const auto coefficients = static_cast<int64_t>(level.a.entries.size());
    // Those of the transpose, and of the operators between two axes, are as many again.
    sum += field * (3 * coefficients + static_cast<int64_t>(level.steps.size()));
  }
  return sum;
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
      const auto& [p, w] = level.steps[s];
      auto next = at::addcmul(x, w, a.residual(b, x));
      if (p != 0.0) next = at::add(next, x - before, p);
      before = std::exchange(x, next);
    }
    return x;
  };
  const auto start = level.steps[0].w * b;
  auto x = smooth(start, at::zeros_like(start), 1);
  auto r = a.residual(b, x);
  for (const auto& t : level.transfers) r = t.restrict(r, transposed);
  auto correction = cycle(l + 1, r, transposed);
  for (auto t = level.transfers.rbegin(); t != level.transfers.rend(); ++t)
    correction = t->interpolate(correction, transposed);
  x = x + correction;
  return smooth(x, x, 0);
}

}  // namespace prdp
