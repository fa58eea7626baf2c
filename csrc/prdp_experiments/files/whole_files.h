#pragma once
#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace prdp {

/// A path and what its file is to hold.
struct NewFile {
  std::filesystem::path path;
  std::string_view content;
};

/// Replaces the file, whole or not at all: it is written under a name that no other process uses, and brought to the
/// disk, before it takes its place. Raises ValueError naming the file that could not be written and the reason; the old
/// file is then still there.
void write_whole(const NewFile& file);

/// The same, and the file that is replaced stays under a second name. Whatever fails in between, no state is lost that
/// was under the first name, and two states are left if there were two.
void write_keeping(const NewFile& file, const std::filesystem::path& before);

/// Where write_both() keeps the first file that it replaces until the second is in its place.
std::filesystem::path kept_of(const std::filesystem::path& path);
/// The same for two files that belong together. Both are brought to the disk before the first one takes its place. If
/// the second cannot take its own, the first is put back. A process that is killed between the two leaves the first one
/// that it has replaced under kept_of() its path.
void write_both(const NewFile& first, const NewFile& second);

/// The bytes of a file; none, with the reason, for what is no regular file or cannot be read.
std::optional<std::string> try_to_read(const std::filesystem::path& path, std::string& wrong);
/// The same. Raises ValueError, in the name of `who`, for what is no regular file or cannot be read.
std::string read_whole(const char* who, const std::filesystem::path& path);

/// Keeps other processes of this library from training into a folder for as long as the object lives. The lock
/// belongs to the process: it ends with it, however it ends. Unfinished files of killed processes are removed.
class FolderLock {
 public:
  /// Raises ValueError if another process holds the lock. A file system without locks is used without one.
  explicit FolderLock(const std::filesystem::path& folder);
  ~FolderLock() { release(); }
  FolderLock(const FolderLock&) = delete;
  FolderLock& operator=(const FolderLock&) = delete;
  void release();

 private:
  int folder_;
};

}  // namespace prdp
