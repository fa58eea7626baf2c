#include "prdp/operators/sum_over_axes.h"

#include "prdp/kernels/fast_diagonalisation.h"
#include "prdp/kernels/stencil.h"

namespace prdp {

namespace {

template <class T>
bool all_are_sums(const kernels::KernelBatch<T>& batch, int64_t samples) {
  for (int64_t s = 0; s < (batch.is_shared ? 1 : samples); ++s) {
    const auto kernel = batch.make(s);
    const auto* stencil = dynamic_cast<const kernels::Stencil<T>*>(kernel.get());
    if (!stencil || !kernels::as_sum_over_axes(stencil->coefficients())) return false;
  }
  return true;
}

}  // namespace

bool is_sum_over_axes(const Operator& a, const at::Tensor& b) {
  const auto kernels = b.is_cpu() && b.numel() > 0 ? a.kernels(b, /*transposed=*/false) : nullptr;
  return kernels && std::visit([&](const auto& batch) { return all_are_sums(batch, b.size(0)); }, kernels->of_dtype);
}

}  // namespace prdp
