#include "prdp/operators/probes.h"

#include <ATen/core/grad_mode.h>

#include "prdp/operators/tensors.h"

namespace prdp {

at::Tensor unstructured_like(const at::Tensor& like) {
  const auto numbers = at::arange(1, like[0].numel() + 1, like.options().dtype(at::kDouble));
  return numbers.square().sin().to(like.scalar_type()).view_as(like[0]).expand_as(like);
}

at::Tensor unlike_numbers(int64_t count, const at::TensorOptions& options) {
  constexpr double golden_ratio = 0.6180339887498949;
  const auto numbers = at::arange(count, options.dtype(at::kDouble));
  const auto signs = at::where((golden_ratio * numbers).frac() < 0.5, 1.0, -1.0);
  return (at::exp2(-numbers.remainder(8)) * signs).to(options);
}

at::Tensor in_each_channel(const at::Tensor& vector, const at::Tensor& like) {
  const int64_t channels = like.dim() > 2 ? like.size(1) : 1;
  return (unlike_numbers(channels, vector.options()).unsqueeze(1) * vector).expand_as(like);
}

at::Tensor estimated_norm(const Operator& a, const at::Tensor& like) {
  const at::NoGradGuard no_grad;
  const auto norm_of = [](const at::Tensor& v) {  // whose squares may leave the range of the dtype
    const auto magnitude = v.abs().flatten(1).amax(1);
    const auto usable = magnitude.gt(0).logical_and(magnitude.isfinite());
    const auto scale = power_of_two_scale(at::where(usable, magnitude, at::ones_like(magnitude)));
    return (v * per_sample(scale, v)).flatten(1).norm(2, 1) / scale;
  };
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
