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

  /// Takes the target's place.
  void finish() {
    if (rename(path_.c_str(), target_.c_str()) != 0) fail_to_write(target_, errno);
    path_.clear();
    // The new name must survive a loss of power as well; not every file system can be told so.
    const auto parent = target_.has_parent_path() ? target_.parent_path() : fs::path(".");
    const int folder = open(parent.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
    if (folder < 0) return;
    fsync(folder);
    close(folder);
  }

 private:
  fs::path target_, path_;
  int file_ = -1;
};

}  // namespace

void write_whole(const std::vector<NewFile>& files) {
  std::vector<Unfinished> unfinished;
  for (const auto& [path, content] : files) unfinished.emplace_back(path).fill(content);
  for (auto& file : unfinished) file.finish();
}

std::string read_whole(const char* who, const fs::path& path) {
  std::error_code error;
  TORCH_CHECK_VALUE(fs::is_regular_file(path, error), who, ": cannot read '", path.string(),
                    "': ", error ? error.message() : "it is not a regular file");
  std::ifstream file(path, std::ios::binary);
  std::ostringstream content;
  if (file.is_open() && file.peek() != EOF) content << file.rdbuf();
  TORCH_CHECK_VALUE(file.is_open() && !file.bad() && !content.fail(), who, ": cannot read '", path.string(),
                    "': ", std::strerror(errno));
  return std::move(content).str();
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
