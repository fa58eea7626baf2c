#include "prdp_experiments/files/checkpoint.h"

#include <c10/util/Exception.h>

#include <cstdlib>

#include "prdp_experiments/files/seal.h"

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
  TORCH_CHECK_VALUE(*rest == '\0' && value >= 0.0, "PRDP_CHECKPOINT_SECONDS: expected a number >= 0, got '", chosen,
                    "'");
  return value;
}

/// Gives the file a second name, which replaces that of an older one. Where it cannot, there is no second file.
void keep_as(const fs::path& second, const fs::path& path) {
  auto unfinished = second;
  unfinished += ".part";  // what a kill leaves is removed with the other unfinished files
  std::error_code error;
  fs::remove(unfinished, error);
  fs::create_hard_link(path, unfinished, error);
  if (error) fs::copy_file(path, unfinished, error);  // not every file system has links
  if (!error) fs::rename(unfinished, second, error);
}

}  // namespace

Checkpoint::Checkpoint(fs::path path, std::string settings)
    : path_(std::move(path)), before_(path_), settings_(std::move(settings)), pause_(seconds()) {
  before_ += ".before";
}

bool Checkpoint::due() const { return Clock::now() - last_ >= pause_; }

void Checkpoint::write(std::string state) {
  keep_as(before_, path_);
  write_sealed(path_, kKind, {settings_, std::move(state)});
  last_ = Clock::now();
}

std::optional<std::string> Checkpoint::read() {
  notice_.clear();
  found_before_ = false;
  std::optional<c10::ValueError> damage;
  try {
    if (auto state = found_in(path_)) return state;
  } catch (const c10::ValueError& error) {
    damage = error;
  }
  try {
    if (auto state = found_in(before_)) {
      if (damage) note_damage();
      found_before_ = true;
      return state;
    }
  } catch (const c10::ValueError& error) {
    if (!damage) damage = error;
  }
  if (damage) throw *damage;
  return std::nullopt;
}

std::string Checkpoint::read_before() {
  std::optional<std::string> state;
  try {
    if (!found_before_) state = found_in(before_);
  } catch (const c10::ValueError&) {
  }
  if (!state) refuse();
  note_damage();
  return *std::move(state);
}

void Checkpoint::refuse() const { refuse_damaged(found_before_ ? before_ : path_, kKind, kRemedy); }

/// None where the file is not there, or is of other settings, which it notes. Raises ValueError for a damaged one.
std::optional<std::string> Checkpoint::found_in(const fs::path& path) {
  auto found = read_sealed(path, kKind, kRemedy);
  if (!found) return std::nullopt;
  if (found->settings == settings_) return std::move(found->content);
  if (notice_.empty())
    notice_ = c10::str("checkpoint: '", path.string(), "' is of other settings or another version; it is not used");
  return std::nullopt;
}

void Checkpoint::note_damage() {
  notice_ = c10::str("checkpoint: '", path_.string(), "' is damaged; the training goes on from the one before");
}

void Checkpoint::check_length(int64_t done, int64_t intervals) const {
  TORCH_CHECK_VALUE(done <= intervals, "checkpoint: '", path_.string(), "' is of a training that has done ", done,
                    " intervals, more than the ", intervals, " asked for; ask for as many, or delete it");
}

void Checkpoint::remove() const {
  for (const auto& path : {before_, path_}) {  // a kill in between leaves the last one
    std::error_code error;
    TORCH_CHECK_VALUE(!fs::is_directory(path, error), "checkpoint: cannot remove '", path.string(),
                      "': it is a folder");
    fs::remove(path, error);
    TORCH_CHECK_VALUE(!error, "checkpoint: cannot remove '", path.string(), "': ", error.message());
  }
}

void Checkpoint::remove_before(const fs::path& record) const {
  std::error_code error, none;
  const auto finished = fs::last_write_time(record, error), kept = fs::last_write_time(path_, none);
  if (!error && !none && kept <= finished) remove();
}

}  // namespace prdp
