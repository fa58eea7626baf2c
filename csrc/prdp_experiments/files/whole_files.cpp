#include "prdp_experiments/files/whole_files.h"

#include <c10/util/Exception.h>
#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>
#include <fstream>
#include <sstream>
#include <utility>

namespace prdp {

namespace fs = std::filesystem;

namespace {

constexpr const char* kUnfinished = ".part";

[[noreturn]] void fail_to_write(const fs::path& path, int error) {
  TORCH_CHECK_VALUE(false, "cannot write '", path.string(), "': ", std::strerror(error));
}

/// The names in the folder of a file must survive a loss of power as well; not every file system can be told so.
void keep_names(const fs::path& path) {
  const auto parent = path.has_parent_path() ? path.parent_path() : fs::path(".");
  const int folder = open(parent.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (folder < 0) return;
  fsync(folder);
  close(folder);
}

/// A file beside `target` that does not replace it yet, and is gone again unless it does.
class Unfinished {
 public:
  explicit Unfinished(fs::path target) : target_(std::move(target)) {
    // Machines that share a folder may give two processes the same number.
    for (int attempt = 0; file_ < 0; ++attempt) {
      path_ = target_;
      path_ += c10::str(".", getpid(), "-", attempt, kUnfinished);
      file_ = open(path_.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
      if (file_ < 0 && errno != EEXIST) fail_to_write(target_, errno);
    }
  }
  Unfinished(Unfinished&& other) noexcept
      : target_(std::move(other.target_)),
        path_(std::exchange(other.path_, {})),
        file_(std::exchange(other.file_, -1)) {}
  ~Unfinished() {
    if (file_ >= 0) close(file_);
    if (!path_.empty()) unlink(path_.c_str());
  }

  /// Writes the content to the disk.
  void fill(std::string_view content) {
    while (!content.empty()) {
      const auto written = ::write(file_, content.data(), content.size());
      if (written < 0 && errno == EINTR) continue;
      if (written < 0) fail_to_write(target_, errno);
      content.remove_prefix(static_cast<size_t>(written));
    }
    if (fsync(file_) != 0) fail_to_write(target_, errno);
    if (close(std::exchange(file_, -1)) != 0) fail_to_write(target_, errno);
  }

  /// Takes what is in the file at `path`: as a second name of it, or as a copy where the file system has no such names.
  void take(const fs::path& path) {
    close(std::exchange(file_, -1));
    unlink(path_.c_str());
    if (link(path.c_str(), path_.c_str()) == 0) return;
    file_ = open(path_.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
    if (file_ < 0) fail_to_write(target_, errno);
    fill(read_whole("cannot copy", path));
  }

  /// Takes the target's place.
  void finish() {
    if (rename(path_.c_str(), target_.c_str()) != 0) fail_to_write(target_, errno);
    path_.clear();
    keep_names(target_);
  }

 private:
  fs::path target_, path_;
  int file_ = -1;
};

}  // namespace

void write_whole(const NewFile& file) {
  Unfinished next(file.path);
  next.fill(file.content);
  next.finish();
}

void write_keeping(const NewFile& file, const fs::path& before) {
  Unfinished next(file.path);
  next.fill(file.content);
  std::error_code none;
  if (!fs::is_regular_file(file.path, none)) return next.finish();
  Unfinished last(before);
  last.take(file.path);
  next.finish();
  last.finish();
}

fs::path kept_of(const fs::path& path) { return fs::path(path) += ".before"; }

void write_both(const NewFile& first, const NewFile& second) {
  Unfinished one(first.path), two(second.path);
  one.fill(first.content);
  two.fill(second.content);
  const auto kept = kept_of(first.path);
  std::error_code error;
  const bool replaces = fs::is_regular_file(first.path, error);
  if (replaces) {
    Unfinished old(kept);
    old.take(first.path);
    old.finish();
  }
  bool placed = false;
  try {
    one.finish();
    placed = true;
    two.finish();
  } catch (const c10::ValueError&) {
    if (placed && replaces) fs::rename(kept, first.path, error);
    if (placed && !replaces) fs::remove(first.path, error);
    fs::remove(kept, error);
    throw;
  }
  fs::remove(kept, error);
}

std::optional<std::string> try_to_read(const fs::path& path, std::string& wrong) {
  std::error_code error;
  if (!fs::is_regular_file(path, error)) {
    wrong = error ? error.message() : "it is not a regular file";
    return std::nullopt;
  }
  std::ifstream file(path, std::ios::binary);
  std::ostringstream content;
  if (file.is_open() && file.peek() != EOF) content << file.rdbuf();
  if (file.is_open() && !file.bad() && !content.fail()) return std::move(content).str();
  wrong = std::strerror(errno);
  return std::nullopt;
}

std::string read_whole(const char* who, const fs::path& path) {
  std::string wrong;
  auto content = try_to_read(path, wrong);
  TORCH_CHECK_VALUE(content, who, ": cannot read '", path.string(), "': ", wrong);
  return *std::move(content);
}

FolderLock::FolderLock(const fs::path& folder) : folder_(open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC)) {
  if (folder_ < 0) return;
  if (flock(folder_, LOCK_EX | LOCK_NB) != 0) {
    const bool held = errno == EWOULDBLOCK;
    release();
    TORCH_CHECK_VALUE(!held, "--out: another process is training into '", folder.string(),
                      "'; wait until it ends, or give another folder");
    return;
  }
  // Nobody else is writing here: what is unfinished stays so.
  std::error_code error;
  for (const auto& entry : fs::directory_iterator(folder, error))
    if (entry.path().extension() == kUnfinished) fs::remove(entry.path(), error);
}

void FolderLock::release() {
  if (folder_ >= 0) close(std::exchange(folder_, -1));
}

}  // namespace prdp
