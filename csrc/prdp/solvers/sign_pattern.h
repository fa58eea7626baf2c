#pragma once
#include <ATen/ATen.h>

#include <cmath>
#include <cstdint>

namespace prdp {

/// Signs without a pattern, the same for every sample: whether number i changes its own.
inline bool is_negated(int64_t i) { return std::sin(static_cast<double>((i + 1) * (i + 1))) < 0.0; }

/// v with its signs changed.
inline at::Tensor with_signs_changed(const at::Tensor& v) {
  const auto places = at::arange(1, v[0].numel() + 1, v.options().dtype(at::kDouble));
  return at::where(places.square().sin().lt(0).view_as(v[0]), -v, v);
}

}  // namespace prdp
