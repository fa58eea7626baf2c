#pragma once
#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <string_view>

/// Files that tell whether they are as they were written: checkpoints, cached data, records.
namespace prdp {

/// Tells contents apart, the same on every machine (FNV-1a): 16 hexadecimal digits.
std::string fingerprint(std::string_view content);

/// A file of bytes, and one line about what they belong to.
struct Sealed {
  std::string settings, content;
};
/// Replaces the file, whole or not at all. `kind` says what it is. Raises ValueError if it cannot be written.
void write_sealed(const std::filesystem::path& path, const char* kind, const Sealed& sealed);
/// The file as it was written; none where there is no file. Raises ValueError, naming the file and the `remedy`
/// ("and …"), for one that is damaged, of another version or no regular file.
std::optional<Sealed> read_sealed(const std::filesystem::path& path, const char* kind, const char* remedy);

/// A JSON object, as text, with its fingerprint as a last entry.
std::string seal_record(std::string_view object);
/// The text of a record's file; none where there is no file. Raises ValueError, naming the file and the remedy, for
/// one that is not as `seal_record` made it, or no regular file.
std::optional<std::string> read_record(const std::filesystem::path& path);

/// Raises the ValueError for the record of a training that finished after other than the `wanted` intervals, and has
/// left nothing to go on from.
[[noreturn]] void refuse_finished(const std::filesystem::path& record, int64_t intervals, int64_t wanted);

/// Raises the ValueError for a file that is not as it was written.
[[noreturn]] void refuse_damaged(const std::filesystem::path& path, const char* kind, const char* remedy);

}  // namespace prdp
