#include "prdp/scenes/checkpoint.h"

#include <c10/util/Exception.h>

#include <cstdlib>

#include "prdp/scenes/seal.h"

namespace prdp {

namespace {

namespace fs = std::filesystem;

constexpr const char *kKind = "checkpoint", *kRemedy = "its training starts afresh";
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

}  // namespace

Checkpoint::Checkpoint(fs::path path, std::string settings)
    : path_(std::move(path)), settings_(std::move(settings)), pause_(seconds()) {}

bool Checkpoint::due() const { return Clock::now() - last_ >= pause_; }

void Checkpoint::write(std::string state) {
  write_sealed(path_, kKind, {settings_, std::move(state)});
  last_ = Clock::now();
}

std::optional<std::string> Checkpoint::read() const {
  auto found = read_sealed(path_, kKind, kRemedy);
  if (!found || found->settings != settings_) return std::nullopt;
  return std::move(found->content);
}

void Checkpoint::refuse() const { refuse_damaged(path_, kKind, kRemedy); }

void Checkpoint::check_length(int64_t done, int64_t intervals) const {
  TORCH_CHECK_VALUE(done <= intervals, "checkpoint: '", path_.string(), "' is of a training that has done ", done,
                    " intervals, more than the ", intervals, " asked for; ask for as many, or delete it");
}

void Checkpoint::remove() const {
  std::error_code error;
  TORCH_CHECK_VALUE(!fs::is_directory(path_, error), "checkpoint: cannot remove '", path_.string(), "': it is a folder");
  fs::remove(path_, error);
  TORCH_CHECK_VALUE(!error, "checkpoint: cannot remove '", path_.string(), "': ", error.message());
}

}  // namespace prdp
