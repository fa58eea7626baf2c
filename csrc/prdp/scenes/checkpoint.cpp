#include "prdp/scenes/checkpoint.h"

#include <c10/util/Exception.h>

#include <cstdlib>
#include <fstream>
#include <iterator>

#include "prdp/scenes/files.h"

namespace prdp {

namespace {

namespace fs = std::filesystem;

constexpr double kSeconds = 10.0;  // between two checkpoints: what a kill may cost, beside one interval

double seconds() {
  const char* chosen = std::getenv("PRDP_CHECKPOINT_SECONDS");
  if (!chosen || !*chosen) return kSeconds;
  char* rest = nullptr;
  const double value = std::strtod(chosen, &rest);
  TORCH_CHECK_VALUE(*rest == '\0' && value >= 0.0,
                    "PRDP_CHECKPOINT_SECONDS: expected a number >= 0, got '", chosen, "'");
  return value;
}

/// The first line: what tells a whole file of this format.
std::string mark(const std::string& content) {
  return "prdp checkpoint 1, " + std::to_string(fingerprint(content));
}

}  // namespace

Checkpoint::Checkpoint(fs::path path, std::string settings)
    : path_(std::move(path)), settings_(std::move(settings)), pause_(seconds()) {}

bool Checkpoint::due() const { return Clock::now() - last_ >= pause_; }

void Checkpoint::write(const std::string& state) {
  const auto content = settings_ + '\n' + state;
  write_whole(path_, mark(content) + '\n' + content);
  last_ = Clock::now();
}

std::optional<std::string> Checkpoint::read() const {
  if (!fs::exists(path_)) return std::nullopt;
  std::ifstream file(path_, std::ios::binary);
  std::string found;
  std::getline(file, found);
  const std::string content{std::istreambuf_iterator<char>(file), {}};
  TORCH_CHECK_VALUE(found == mark(content), "checkpoint: '", path_.string(),
                    "' is damaged; delete it, and its training starts afresh");
  const auto end = content.find('\n');
  if (content.substr(0, end) != settings_) return std::nullopt;
  return content.substr(end + 1);
}

void Checkpoint::remove() const {
  std::error_code error;
  fs::remove(path_, error);
  TORCH_CHECK_VALUE(!error, "checkpoint: cannot remove '", path_.string(), "': ", error.message());
  fs::remove(path_.string() + ".part", error);  // where a write was killed
}

}  // namespace prdp
