#include "prdp/gpu/kernel_cache.h"

#include <unistd.h>

#include <array>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iterator>

namespace prdp::gpu::kernel_cache {

namespace {

namespace fs = std::filesystem;

/// FNV-1a on two lanes: names and checksums, not secrets.
std::string hash(const std::string& text) {
  std::array<uint64_t, 2> lanes{0xcbf29ce484222325ULL, 0x84222325cbf29ce4ULL};
  for (const char c : text)
    for (auto& lane : lanes)
      lane = (lane ^ static_cast<unsigned char>(c)) * (&lane == &lanes[0] ? 0x100000001b3ULL : 0x100000001cfULL);
  std::string name;
  for (const auto lane : lanes)
    for (int shift = 60; shift >= 0; shift -= 4) name += "0123456789abcdef"[lane >> shift & 15];
  return name;
}

/// Empty: there is none.
fs::path folder() {
  const char *chosen = std::getenv("PRDP_CACHE"), *home = std::getenv("HOME");
  if (chosen && *chosen) return fs::path(chosen) / "kernels";
  return home && *home ? fs::path(home) / ".cache" / "prdp_torch" / "kernels" : fs::path();
}

constexpr size_t kHashLength = 32;

}  // namespace

std::string key_of(const std::string& everything) { return hash(everything); }

std::optional<std::string> find(const std::string& key) {
  if (folder().empty()) return std::nullopt;
  std::ifstream file(folder() / key, std::ios::binary);
  if (!file) return std::nullopt;
  const std::string all{std::istreambuf_iterator<char>(file), {}};
  if (all.size() > kHashLength && hash(all.substr(kHashLength)) == all.substr(0, kHashLength))
    return all.substr(kHashLength);
  std::error_code ignored;
  fs::remove(folder() / key, ignored);
  return std::nullopt;
}

void keep(const std::string& key, const std::string& binary) {
  if (folder().empty()) return;
  std::error_code failed;
  fs::create_directories(folder(), failed);
  const auto part = folder() / (key + "." + std::to_string(getpid()));
  {
    std::ofstream file(part, std::ios::binary);
    file << hash(binary) << binary;
    file.close();
    if (file) fs::rename(part, folder() / key, failed);
    else failed = std::make_error_code(std::errc::io_error);
  }
  std::error_code ignored;
  if (failed) fs::remove(part, ignored);
}

}  // namespace prdp::gpu::kernel_cache
