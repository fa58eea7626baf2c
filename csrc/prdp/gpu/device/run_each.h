#pragma once
#include "prdp/gpu/device/each.h"
#include "prdp/gpu/device/team.h"

/// The bodies of kernels that are loops.
namespace prdp::gpu {

template <class Of>
void run(const EachPoint<Of>& loop) {
  const int threads = static_cast<int>(gridDim.x * blockDim.x);
  for (int i = static_cast<int>(blockIdx.x * blockDim.x + threadIdx.x); i < loop.count; i += threads) loop.of(i);
}

template <int kBlocks, int kThreads, class Of>
void run(const EachSample<Of>& loop) {
  for_samples_of_team<kBlocks, kThreads>(
      loop, loop.batch, [&](int64_t sample, auto& team, int) { loop.of(static_cast<int>(sample), team); });
}

}  // namespace prdp::gpu
