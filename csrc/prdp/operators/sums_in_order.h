#pragma once
#include <ATen/ATen.h>
#include <ATen/Parallel.h>
#include <ATen/TensorSubclassLikeUtils.h>

#include <numeric>
#include <vector>

/// Sums whose last bit depends neither on the number of threads nor on the rest of the batch. Differentiable.
namespace prdp {

/// sum(t, axes), with axes counted from the end. PyTorch splits a large sum among the threads if it is the only one of
/// its tensor, and its last bit then depends on their number. So two copies are summed, each by one thread.
template <class Sum>
at::Tensor in_order(const at::Tensor& t, at::IntArrayRef axes, const Sum& sum) {
  if (!t.is_cpu() || at::isTensorSubclassLike(t) || t.numel() < at::internal::GRAIN_SIZE) return sum(t, axes);
  const bool is_only_one = t.numel() == std::accumulate(axes.begin(), axes.end(), int64_t{1},
                                                        [&](int64_t n, int64_t axis) { return n * t.size(axis); });
  if (!is_only_one) return sum(t, axes);
  auto twice = t.sizes().vec();
  twice.insert(twice.begin(), 2);
  return sum(t.expand(twice), axes).select(0, 0);
}

/// Σ over these axes, which keep an extent of one; and the mean.
inline at::Tensor sum_in_order(const at::Tensor& t, at::IntArrayRef axes) {
  return in_order(t, axes, [](const at::Tensor& all, at::IntArrayRef over) { return all.sum(over, /*keepdim=*/true); });
}
inline at::Tensor mean_in_order(const at::Tensor& t, at::IntArrayRef axes) {
  return in_order(t, axes,
                  [](const at::Tensor& all, at::IntArrayRef over) { return all.mean(over, /*keepdim=*/true); });
}
/// Σ of all numbers.
inline at::Tensor total(const at::Tensor& t) {
  std::vector<int64_t> axes(t.dim());
  std::iota(axes.begin(), axes.end(), -t.dim());
  return sum_in_order(t, axes).reshape({});
}
/// Σ of all numbers of each sample, (batch, 1, …).
inline at::Tensor sample_totals(const at::Tensor& t) {
  if (t.dim() == 1) return t;
  std::vector<int64_t> axes(t.dim() - 1);
  std::iota(axes.begin(), axes.end(), 1 - t.dim());
  return sum_in_order(t, axes);
}
/// v·w of each sample, (batch, 1, …).
inline at::Tensor dot_in_order(const at::Tensor& v, const at::Tensor& w) { return sample_totals(v * w); }

/// v (batch, fields, n) without Σ_k (v·dual_k) part_k. `dual`, `parts`: (k, n), or (batch or 1, k, n). A matrix product
/// would sum one row in another order than many.
inline at::Tensor without_parts(at::Tensor v, const at::Tensor& dual, const at::Tensor& parts) {
  const auto whole = v;
  const auto vector = [](const at::Tensor& of, int64_t k) { return of.narrow(-2, k, 1); };
  for (int64_t k = 0; k < parts.size(-2); ++k) v = v - sum_in_order(whole * vector(dual, k), {-1}) * vector(parts, k);
  return v;
}

}  // namespace prdp
