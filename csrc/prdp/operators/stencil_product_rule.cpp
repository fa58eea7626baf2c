#include <ATen/TensorSubclassLikeUtils.h>
#include <ATen/core/grad_mode.h>

#include <algorithm>

#include "prdp/kernels/stencil_products.h"
#include "prdp/operators/product_rule_kernels.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/threads/interruption.h"

/// The product rule of a Stencil: in one launch on a GPU, by loops on the CPU, or in tensor operations.
namespace prdp {

namespace {

/// The product rule by loops: products (batch or 1, k, *shape) from λ and u (batch, channel, *shape).
template <class T>
void add_all_products(const kernels::StencilSparsity& pattern, const at::Tensor& lambda, const at::Tensor& u,
                      const at::Tensor& products) {
  const int64_t samples = lambda.size(0), channels = lambda.size(1), given = products.size(1);
  if (products.numel() == 0) return;  // an empty batch
  const int64_t points = products.numel() / (products.size(0) * given);
  const int64_t share = products.size(0) == 1 ? samples : 1;  // samples that add up to one product
  const auto *l = lambda.const_data_ptr<T>(), *v = u.const_data_ptr<T>();
  auto* out = products.mutable_data_ptr<T>();
  constexpr int64_t worthwhile = 1 << 18;  // multiplications for a thread
  const int64_t grain = std::max<int64_t>(1, worthwhile / std::max<int64_t>(1, share * channels * points));
  interruption::parallel_for(0, products.size(0) * given, grain, [&](int64_t begin, int64_t end) {
    for (int64_t p = begin; p < end; ++p) {
      const int64_t place = pattern.places[p % given], first = p / given * channels;
      for (int64_t field = first; place >= 0 && field < first + share * channels; ++field)
        kernels::add_products(pattern.grid, pattern.offsets[place], l + field * points, v + field * points,
                              out + p * points);
    }
  });
}

/// The same in one launch; undefined where there is no kernel.
template <class T>
at::Tensor product_rule_by_kernel(const kernels::StencilSparsity& pattern, const std::vector<kernels::Offset>& offsets,
                                  const at::Tensor& lambda, const at::Tensor& u, const at::Tensor& coefficients) {
  const auto out = at::empty(coefficients.sizes(), coefficients.options());
  gpu::StencilProductRule<T> of{};
  of.pair = pair_of<T>(lambda, u, out.size(0));
  of.count = static_cast<int>(offsets.size());
  of.out = out.mutable_data_ptr<T>();
  for (int axis = 0; axis < 3; ++axis) {
    of.n[axis] = static_cast<int>(pattern.grid.shape[axis]);
    of.periodic[axis] = pattern.grid.periodic[axis];
    for (size_t k = 0; k < offsets.size(); ++k) of.offsets[k][axis] = static_cast<signed char>(offsets[k].along[axis]);
  }
  const bool launched = gpu::each_point(out.device(), product_rule_body<T>("StencilProductRule"), of, out.numel());
  return launched ? out : at::Tensor();
}

}  // namespace

std::vector<at::Tensor> StencilOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  if (has_product_rule_kernel(lambda, u)) {
    const auto by_kernel =
        lambda.scalar_type() == at::kFloat ? product_rule_by_kernel<float> : product_rule_by_kernel<double>;
    const kernels::StencilSparsity pattern(grid_, offsets_);
    const auto all = by_kernel(pattern, offsets_, lambda.contiguous(), u.contiguous(), coefficients_);
    if (all.defined()) return {all};
  }
  const bool plain = !at::isTensorSubclassLike(lambda) && !at::isTensorSubclassLike(u);
  if (!at::GradMode::is_enabled() && plain && lambda.is_cpu()) {
    const auto all = at::zeros(coefficients_.sizes(), coefficients_.options());
    const kernels::StencilSparsity pattern(grid_, offsets_);
    const auto add = lambda.scalar_type() == at::kFloat ? add_all_products<float> : add_all_products<double>;
    add(pattern, lambda.contiguous(), u.contiguous(), all);
    return {all};
  }
  std::vector<at::Tensor> products;
  for (const auto& offset : offsets_) products.push_back((lambda * shifted(u, offset)).sum(1));
  const auto all = at::stack(products, 1);
  return {coefficients_.sym_size(0) == 1 ? all.sum(0, /*keepdim=*/true) : all};
}

}  // namespace prdp
