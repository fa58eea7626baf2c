#pragma once
#include <ATen/Parallel.h>

#include <algorithm>

#include "prdp/gpu/runtime.h"

namespace prdp::gpu {

/// Blocks that work on a sample together, and threads in each.
struct TeamSize {
  int64_t blocks, threads;
};

/// For a sample of so many points, by the device and the sample alone: no result depends on the batch. Where the device
/// has not as many blocks, each takes more points.
inline TeamSize team_size(int64_t points, const Limits& limits) {
  constexpr int64_t warp = 32;
  const int64_t blocks = std::min(at::divup(points, limits.cells_of_block), limits.blocks);
  return {blocks, std::min(limits.threads, at::divup(at::divup(points, blocks), warp) * warp)};
}

}  // namespace prdp::gpu
