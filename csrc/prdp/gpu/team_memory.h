#pragma once
#include <ATen/ATen.h>

#include "prdp/gpu/device/arguments.h"

namespace prdp::gpu {

/// Where the blocks of a team meet, and where they add up; nothing for teams of one block.
struct TeamMemory {
  TeamMemory() = default;
  TeamMemory(int64_t blocks, int64_t teams, const at::TensorOptions& options) {
    if (blocks == 1) return;
    arrived = at::zeros({32 * teams}, options.dtype(at::kInt));
    parts = at::empty({2 * kMostAtOnce * blocks * teams}, options.dtype(at::kDouble));
  }
  /// Into the arguments of a kernel.
  template <class Arguments>
  void put_into(Arguments& arguments) const {
    if (!arrived.defined()) return;
    arguments.arrived = static_cast<unsigned*>(arrived.mutable_data_ptr());
    arguments.parts = parts.mutable_data_ptr<double>();
  }

  at::Tensor arrived, parts;
};

}  // namespace prdp::gpu
