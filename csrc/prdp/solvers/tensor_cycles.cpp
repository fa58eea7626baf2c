#include "prdp/solvers/tensor_cycles.h"

#include <ATen/core/grad_mode.h>

#include "prdp/kernels/coarsening.h"
#include "prdp/operators/tensors.h"

namespace prdp {

namespace {

std::vector<int> axes_to_coarsen(const TensorStencil& a, const at::Tensor& magnitudes) {
  const auto host = magnitudes.flatten(1).sum(1).to(at::kCPU, at::kDouble);
  std::vector<double> coupling(a.dim());
  for (size_t e = 0; e < a.entries.size(); ++e)
    for (int64_t d = 0; d < a.dim(); ++d)
      if (a.entries[e].offset[d] != 0) coupling[d] += host.const_data_ptr<double>()[e];
  return kernels::axes_to_coarsen(a.shape, coupling);
}

}  // namespace

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
    const auto magnitudes = stencil.coefficients().abs();
    // The radius of each sample, to which q is inverse.
    const auto ratios = magnitudes.sum(0) / magnitudes.select(0, 0);
    const auto radius = per_sample(ratios.flatten(1).amax(1), ratios),
               per_radius = (radius * stencil.diagonal()).reciprocal();
    for (const auto& [p, q] : kernels::smoothing_steps(1.0, smoothing))
      level.steps.push_back({p, (q * per_radius).unsqueeze(1)});
    const auto axes = axes_to_coarsen(stencil, magnitudes);
    if (axes.empty()) break;
    for (const auto axis : axes) {
      const auto& transfer =
          level.transfers.emplace_back(stencil, axis == axes.front() ? level.transpose : stencil.transposed(), axis);
      stencil = transfer.coarse_operator(stencil);
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
