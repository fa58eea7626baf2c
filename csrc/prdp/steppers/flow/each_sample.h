#pragma once
#include <ATen/ATen.h>

#include <algorithm>

#include "prdp/threads/interruption.h"

namespace prdp {

/// f(sample) for each of a batch (batch, …), in several threads where a sample has enough values for one.
template <class F>
void for_each_sample(const at::Tensor& batch, const F& f) {
  constexpr int64_t values_of_thread = 32768;
  const int64_t samples = batch.size(0), values = samples ? batch.numel() / samples : 0;
  const int64_t grain = std::max<int64_t>(1, values_of_thread / std::max<int64_t>(1, values));
  interruption::parallel_for(0, samples, grain, [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s < end; ++s) f(s);
  });
}

}  // namespace prdp
