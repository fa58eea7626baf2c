#pragma once
#include <cstdint>
#include <optional>
#include <string>

/// Compiled kernels on disk, for the next process, in the folder `kernels` of PRDP_CACHE, else of ~/.cache/prdp_torch.
/// A file that is damaged is made again, and a folder that cannot be written to is as good as none.
namespace prdp::gpu::kernel_cache {

/// The hash of all that decides on the result: text, options, versions, architecture.
std::string key_of(const std::string& everything);
std::optional<std::string> find(const std::string& key);
void keep(const std::string& key, const std::string& binary);

}  // namespace prdp::gpu::kernel_cache
