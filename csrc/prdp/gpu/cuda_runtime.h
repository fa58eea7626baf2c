#pragma once
#include "prdp/gpu/runtime.h"

namespace prdp::gpu {

/// NVIDIA's driver and NVRTC, as torch has loaded them. Nothing is loaded before the first kernel is asked for.
Runtime& cuda_runtime();

}  // namespace prdp::gpu
