#include "prdp_experiments/files/archive.h"

#include <c10/util/Exception.h>

#include <cstdint>
#include <cstring>

namespace prdp {

namespace {

constexpr std::string_view kEntry = "PK\1\2", kFile = "PK\3\4", kEnd = "PK\5\6", kEnd64 = "PK\6\6",
                           kLocator64 = "PK\6\7";
constexpr uint32_t kIn64 = 0xFFFFFFFF;  // the number is elsewhere, in 64 bits

/// Bytes that are looked at where other bytes say.
class Places {
 public:
  explicit Places(std::string_view all) : all_(all) {}

  std::string_view at(uint64_t from, uint64_t count) const {
    TORCH_CHECK_VALUE(from <= all_.size() && count <= all_.size() - from, "archive: its end is missing");
    return all_.substr(from, count);
  }
  template <class T>
  uint64_t number(uint64_t from) const {
    T value;
    std::memcpy(&value, at(from, sizeof value).data(), sizeof value);
    return value;
  }
  void expect(std::string_view mark, uint64_t from) const {
    TORCH_CHECK_VALUE(at(from, mark.size()) == mark, "archive: no archive, or a damaged one");
  }

 private:
  std::string_view all_;
};

struct Entry {
  uint64_t size, stored, place;
};

/// Puts in the numbers that take 64 bits, from the extra field of an entry.
void complete(Entry& entry, const Places& extra, uint64_t end) {
  for (uint64_t at = 0; at + 4 <= end; at += 4 + extra.number<uint16_t>(at + 2)) {
    if (extra.number<uint16_t>(at) != 1) continue;
    uint64_t next = at + 4;
    for (auto* number : {&entry.size, &entry.stored, &entry.place}) {
      if (*number != kIn64) continue;
      *number = extra.number<uint64_t>(next);
      next += 8;
    }
  }
}

}  // namespace

std::map<std::string, std::string_view> archived_files(std::string_view archive) {
  const Places bytes(archive);
  const auto end = archive.rfind(kEnd);
  TORCH_CHECK_VALUE(end != archive.npos, "archive: no archive, or its end is missing");
  uint64_t entries = bytes.number<uint16_t>(end + 10), at = bytes.number<uint32_t>(end + 16);
  if (entries == 0xFFFF || at == kIn64) {
    bytes.expect(kLocator64, end - 20);
    const auto end64 = bytes.number<uint64_t>(end - 12);
    bytes.expect(kEnd64, end64);
    entries = bytes.number<uint64_t>(end64 + 32);
    at = bytes.number<uint64_t>(end64 + 48);
  }
  std::map<std::string, std::string_view> files;
  uint64_t together = 0;
  for (; entries > 0; --entries) {
    bytes.expect(kEntry, at);
    const auto compression = bytes.number<uint16_t>(at + 10);
    Entry entry{bytes.number<uint32_t>(at + 24), bytes.number<uint32_t>(at + 20), bytes.number<uint32_t>(at + 42)};
    const auto name = bytes.number<uint16_t>(at + 28), extra = bytes.number<uint16_t>(at + 30);
    complete(entry, Places(bytes.at(at + 46 + name, extra)), extra);
    TORCH_CHECK_VALUE(compression == 0 && entry.size == entry.stored, "archive: its files are compressed");

    bytes.expect(kFile, entry.place);
    const auto before = 30 + bytes.number<uint16_t>(entry.place + 26) + bytes.number<uint16_t>(entry.place + 28);
    files[std::string(bytes.at(at + 46, name))] = bytes.at(entry.place + before, entry.size);
    together += entry.size;
    TORCH_CHECK_VALUE(together <= archive.size(), "archive: its files overlap");
    at += 46 + name + extra + bytes.number<uint16_t>(at + 32);
  }
  return files;
}

}  // namespace prdp
