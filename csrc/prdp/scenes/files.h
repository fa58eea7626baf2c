#pragma once
#include <cstdint>
#include <filesystem>
#include <string>
#include <string_view>

namespace prdp {

/// Writes under the path with `suffix`, then moves it there: a file is whole or not there. Raises
/// ValueError naming a file that cannot be written.
void write_whole(const std::filesystem::path& path, std::string_view content,
                 const std::string& suffix = ".part");

/// Tells contents apart, the same on every machine (FNV-1a).
uint64_t fingerprint(std::string_view content);

}  // namespace prdp
