#pragma once
#include <string>
#include <vector>

namespace prdp::gpu::nvrtc {

/// A kernel compiled for devices of this compute capability, such as 90: a cubin, or PTX for a device that this NVRTC
/// does not know yet. Kept on disk. Raises Unavailable.
std::string compile(const std::string& text, int capability);
/// What the compiler says of it: registers, spills, memory of a block.
std::string resources(const std::string& text, int capability);

}  // namespace prdp::gpu::nvrtc
