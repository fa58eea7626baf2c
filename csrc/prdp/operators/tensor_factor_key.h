#pragma once
#include <ATen/ATen.h>

#include "prdp/kernels/factor_cache.h"

namespace prdp {

/// Hashes the numbers of a tensor on the CPU.
inline kernels::FactorKeyMaker& add_numbers(kernels::FactorKeyMaker& key, const at::Tensor& t) {
  const bool single = t.scalar_type() == at::kFloat;
  const auto values = t.detach().to(single ? at::kFloat : at::kDouble).contiguous();
  key.add(int64_t{single}).add(values.numel());
  if (values.numel() == 0) return key;
  if (single) return key.add_field(values.const_data_ptr<float>(), values.numel());
  return key.add_field(values.const_data_ptr<double>(), values.numel());
}

}  // namespace prdp
