#pragma once
#include <cstdint>
#include <filesystem>
#include <string>
#include <string_view>
#include <vector>

namespace prdp {

/// A path and what its file is to hold.
struct NewFile {
  std::filesystem::path path;
  std::string_view content;
};

/// Replaces the files, each whole or not at all. All of them are written under names that no other process uses,
/// and brought to the disk, before the first one takes its place. Raises ValueError naming the file that could not
/// be written and the reason; the old files are then still there.
void write_whole(const std::vector<NewFile>& files);

/// The bytes of a file. Raises ValueError, in the name of `who`, for what is no regular file or cannot be read.
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
