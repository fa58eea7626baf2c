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
  const int number = static_cast<int>(blockIdx.x) / kBlocks, rank = static_cast<int>(blockIdx.x) % kBlocks;
  Team<kBlocks, kThreads> team(rank, loop.arrived + 32 * number, loop.parts + 2 * kMostAtOnce * kBlocks * number);
  for (int sample = number; sample < loop.batch; sample += static_cast<int>(gridDim.x) / kBlocks) loop.of(sample, team);
}

}  // namespace prdp::gpu
