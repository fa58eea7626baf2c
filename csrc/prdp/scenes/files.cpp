#include "prdp/scenes/files.h"

#include <c10/util/Exception.h>

#include <fstream>

namespace prdp {

namespace fs = std::filesystem;

void write_whole(const fs::path& path, std::string_view content, const std::string& suffix) {
  auto unfinished = path;
  unfinished += suffix;
  std::ofstream file(unfinished, std::ios::binary);
  file.write(content.data(), static_cast<std::streamsize>(content.size()));
  file.close();
  std::error_code error;
  if (file) fs::rename(unfinished, path, error);
  if (file && !error) return;
  std::error_code ignored;
  fs::remove(unfinished, ignored);
  TORCH_CHECK_VALUE(false, "cannot write '", path.string(), "'; is the disk full?");
}

uint64_t fingerprint(std::string_view content) {
  uint64_t h = 14695981039346656037u;
  for (const unsigned char c : content) h = (h ^ c) * 1099511628211u;
  return h;
}

}  // namespace prdp
