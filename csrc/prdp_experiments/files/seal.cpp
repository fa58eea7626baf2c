#include "prdp_experiments/files/seal.h"

#include <c10/util/Exception.h>

#include <algorithm>
#include <cinttypes>
#include <cstdio>

#include "prdp_experiments/files/whole_files.h"

namespace prdp {

namespace fs = std::filesystem;

namespace {

/// The first line of a sealed file.
std::string mark(const char* kind, std::string_view rest) {
  return std::string("prdp ") + kind + " 2, " + fingerprint(rest) + '\n';
}

constexpr const char* kNotAsWritten = "its content is not that of its fingerprint";
constexpr std::string_view kBefore = ",\n \"fingerprint\": \"", kBehind = "\"\n}\n";

/// In one line of ASCII letters, whatever bytes were read.
std::string printable(std::string_view text) {
  constexpr size_t kLongest = 1000;
  std::string line(text.substr(0, kLongest));
  std::replace_if(line.begin(), line.end(), [](char c) { return c < ' ' || c > '~'; }, '?');
  return line;
}

bool is_there(const fs::path& path) {
  std::error_code error;  // a path that cannot be looked at is left to the reader to refuse
  return fs::exists(path, error) || error;
}

}  // namespace

std::string fingerprint(std::string_view content) {
  uint64_t h = 14695981039346656037u;
  for (const unsigned char c : content) h = (h ^ c) * 1099511628211u;
  char digits[17];
  std::snprintf(digits, sizeof digits, "%016" PRIx64, h);
  return digits;
}

void refuse_finished(const fs::path& record, int64_t intervals, int64_t wanted) {
  TORCH_CHECK_VALUE(false, "record: '", record.string(), "' is of a finished training of ", intervals,
                    " intervals, not ", wanted,
                    "; it cannot go on: give another --out, or leave out --resume to "
                    "train afresh");
}

std::string damage(const fs::path& path, const char* kind, std::string_view wrong) {
  return c10::str(kind, ": '", path.string(), "' is damaged or of another version: ", printable(wrong));
}

void refuse_damaged(const fs::path& path, const char* kind, std::string_view wrong, const char* remedy) {
  TORCH_CHECK_VALUE(false, damage(path, kind, wrong), "; delete it, and ", remedy);
}

std::string seal(const char* kind, const Sealed& sealed) {
  auto file = sealed.settings + '\n' + sealed.content;
  return file.insert(0, mark(kind, file));
}

std::optional<Opened> open_sealed(const fs::path& path, const char* kind) {
  if (!is_there(path)) return std::nullopt;
  Opened opened;
  const auto file = try_to_read(path, opened.wrong);
  if (!file) return opened;
  const auto rest = std::string_view(*file).substr(std::min(file->size(), file->find('\n') + 1));
  const auto end = rest.find('\n');
  if (end == rest.npos || file->compare(0, file->size() - rest.size(), mark(kind, rest)) != 0)
    opened.wrong = kNotAsWritten;
  else opened.sealed = Sealed{std::string(rest.substr(0, end)), std::string(rest.substr(end + 1))};
  return opened;
}

std::string seal_record(std::string_view object) {
  auto body = object.substr(0, object.rfind('}'));
  body = body.substr(0, body.find_last_not_of(" \n") + 1);
  std::string text(body);
  return text.append(kBefore).append(fingerprint(body)).append(kBehind);
}

std::optional<std::string> read_record(const fs::path& path) {
  if (!is_there(path)) return std::nullopt;
  auto text = read_whole("record", path);
  const auto end = text.rfind(kBefore);
  if (end == text.npos || seal_record(text.substr(0, end) + "}") != text)
    refuse_damaged(path, "record", kNotAsWritten, kRecordRemedy);
  return text;
}

}  // namespace prdp
