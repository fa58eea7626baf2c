#include "prdp/operators/probes.h"

#include <ATen/core/grad_mode.h>

#include "prdp/operators/tensors.h"

namespace prdp {

at::Tensor unstructured_like(const at::Tensor& like) {
  const auto numbers = at::arange(1, like[0].numel() + 1, like.options().dtype(at::kDouble));
  return numbers.square().sin().to(like.scalar_type()).view_as(like[0]).expand_as(like);
}

at::Tensor estimated_norm(const Operator& a, const at::Tensor& like) {
  const at::NoGradGuard no_grad;
  const auto norm_of = [](const at::Tensor& v) { return v.flatten(1).norm(2, 1); };
  constexpr int products = 4;
  auto v = unstructured_like(like);
  v = v / per_sample(norm_of(v), v);
  at::Tensor largest;
  for (int k = 0; k < products; ++k) {
    v = a.apply(v.contiguous());
    const auto grown = norm_of(v).nan_to_num(0.0, 0.0, 0.0);
    largest = k == 0 ? grown : at::maximum(largest, grown);
    v = v / per_sample(at::where(grown.gt(0), grown, at::ones_like(grown)), v);
  }
  return largest;
}

}  // namespace prdp
