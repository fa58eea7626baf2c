#include "prdp_experiments/files/checkpoint.h"

#include <c10/util/Exception.h>

#include <algorithm>
#include <cstdlib>
#include <utility>

#include "prdp_experiments/files/seal.h"
#include "prdp_experiments/files/whole_files.h"

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

}  // namespace

Checkpoint::Checkpoint(fs::path path, std::string settings)
    : path_(std::move(path)), before_(path_), settings_(std::move(settings)), pause_(seconds()) {
  before_ += ".before";
}

bool Checkpoint::due() const { return Clock::now() - last_ >= pause_; }

void Checkpoint::write(std::string state) {
  const auto file = seal(kKind, {settings_, std::move(state)});
  last_is_good_ ? write_keeping({path_, file}, before_) : write_whole({path_, file});
  last_is_good_ = true;
  last_ = Clock::now();
}

std::vector<Checkpoint::Found> Checkpoint::find() {
  notice_.clear();
  std::vector<Found> found;
  find_in(path_, found);
  last_is_good_ = !found.empty() && found[0].wrong.empty();
  find_in(before_, found);
  const auto usable = [](const Found& one) { return one.wrong.empty(); };
  if (!found.empty() && std::none_of(found.begin(), found.end(), usable))
    refuse_damaged(found[0].path, kKind, found[0].wrong, kRemedy);
  return found;
}

bool Checkpoint::is_of_another(const fs::path& path) const {
  const auto opened = open_sealed(path, kKind);
  return opened && opened->sealed && opened->sealed->settings != settings_;
}

void Checkpoint::refuse_other(const fs::path& record) const {
  remove_before(record);
  for (const auto& path : {path_, before_}) {
    TORCH_CHECK_VALUE(!is_of_another(path), "checkpoint: '", path.string(),
                      "' is of a training that has not ended, with other settings or of another version; give its "
                      "settings and --resume to go on with it, or another --out, or delete the file");
  }
}

void Checkpoint::refuse_to_lose(const fs::path& record) {
  remove_before(record);
  std::vector<Found> found;
  for (const auto& path : {path_, before_}) find_in(path, found);
  for (const auto& one : found)
    TORCH_CHECK_VALUE(!one.wrong.empty(), "checkpoint: '", one.path.string(),
                      "' is of a training that has not ended: pass --resume to go on with it, or delete the file to "
                      "train afresh");
}

void Checkpoint::find_in(const fs::path& path, std::vector<Found>& found) {
  auto opened = open_sealed(path, kKind);
  if (!opened) return;
  if (!opened->sealed) return found.push_back({path, {}, opened->wrong});
  if (opened->sealed->settings == settings_) return found.push_back({path, std::move(opened->sealed->content), {}});
  if (notice_.empty())
    notice_ = c10::str("checkpoint: '", path.string(), "' is of other settings or another version; it is not used");
}

bool Checkpoint::restore(const std::vector<Found>& found, const Load& load) {
  const Found* first = nullptr;
  std::string wrong;
  for (const auto& one : found) {
    auto fault = one.wrong;
    if (fault.empty()) {
      try {
        Saved saved(unpack(one.state));
        load(saved);
        saved.finish();
        if (first) notice_ = damage(first->path, kKind, wrong) + "; the training goes on from the one before";
        return true;
      } catch (const c10::ValueError& error) {
        fault = error.what_without_backtrace();
      }
    }
    if (one.path == path_) last_is_good_ = false;
    if (!std::exchange(first, first ? first : &one)) wrong = fault;
  }
  if (first) refuse_damaged(first->path, kKind, wrong, kRemedy);
  return false;
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
  if (!error && !none && kept <= finished && !is_of_another(path_)) remove();
}

}  // namespace prdp
