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
/// A file as it was written; none, with the reason, where it is not.
struct Opened {
  std::optional<Sealed> sealed;
  std::string wrong;
};

/// The bytes of a sealed file. `kind` says what it is.
std::string seal(const char* kind, const Sealed& sealed);
/// None where there is no file.
std::optional<Opened> open_sealed(const std::filesystem::path& path, const char* kind);
/// "'PATH' is damaged or of another version: WRONG", in one line.
std::string damage(const std::filesystem::path& path, const char* kind, std::string_view wrong);
/// Raises ValueError with that and the remedy, "delete it, and REMEDY".
[[noreturn]] void refuse_damaged(const std::filesystem::path& path, const char* kind, std::string_view wrong,
                                 const char* remedy);

/// What is done about a damaged record.
inline constexpr const char* kRecordRemedy = "its training is run again";
/// A JSON object, as text, with its fingerprint as a last entry.
std::string seal_record(std::string_view object);
/// The text of a record's file; none where there is no file. Raises ValueError, naming the file, what is wrong and the
/// remedy, for one that is not as `seal_record` made it, or no regular file.
std::optional<std::string> read_record(const std::filesystem::path& path);

/// Raises the ValueError for the record of a training that finished after other than the `wanted` intervals, and has
/// left nothing to go on from.
[[noreturn]] void refuse_finished(const std::filesystem::path& record, int64_t intervals, int64_t wanted);

}  // namespace prdp
