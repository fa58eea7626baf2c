#pragma once
#include <ATen/ATen.h>

#include <vector>

namespace prdp {

/// A velocity: one tensor (batch, d, *shape), or one (batch, 1, *shape) for each channel.
using FlowParts = std::vector<at::Tensor>;

inline at::Tensor joined(const FlowParts& parts) {
  return parts.empty() ? at::Tensor() : parts.size() == 1 ? parts[0] : at::cat(parts, 1);
}

}  // namespace prdp
