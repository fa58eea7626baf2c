#include "prdp_experiments/files/record.h"

#include <c10/util/Exception.h>

#include <string>
#include <utility>

#include "prdp_experiments/files/record_keys.h"
#include "prdp_experiments/files/seal.h"
#include "prdp_experiments/files/whole_files.h"

namespace prdp {

namespace fs = std::filesystem;

namespace {

/// None where the file is not there, or is not readable.
std::optional<std::string> content_of(const fs::path& path) {
  std::string wrong;
  return try_to_read(path, wrong);
}

/// The fingerprint of the weights of a record; empty where there is none.
std::string weights_of_record(const fs::path& path) {
  const auto record = read_training(path);
  return record ? record->value("weights", std::string()) : std::string();
}

}  // namespace

std::optional<Json> read_training(const fs::path& path) {
  const auto text = read_record(path);
  if (!text) return std::nullopt;
  try {
    auto record = parse_shallow(*text);
    check_training(record);
    return record;
  } catch (const c10::ValueError& error) {
    refuse_damaged(path, "record", error.what_without_backtrace(), kRecordRemedy);
  }
}

fs::path weights_of(const fs::path& record) { return fs::path(record).replace_extension(".pt"); }

void write_training(const fs::path& path, std::string_view object, std::string_view weights) {
  const auto record = seal_record(object);
  if (weights.empty()) return write_whole({path, record});
  write_both({weights_of(path), weights}, {path, record});
}

std::optional<std::string> read_weights(const fs::path& path, std::string_view wanted) {
  const auto weights = weights_of(path);
  const auto content = content_of(weights);
  if (content && fingerprint(*content) == wanted) return content;
  const auto kept = content_of(kept_of(weights));
  if (kept && fingerprint(*kept) == wanted) return kept;
  std::error_code error;
  if (!content && !fs::exists(weights, error)) return std::nullopt;
  TORCH_CHECK_VALUE(false, "weights: '", weights.string(),
                    "' is damaged or not of the record beside it; delete both, and the training is run again");
}

void settle_weights(const fs::path& path) {
  const auto weights = weights_of(path), kept = kept_of(weights);
  const auto aside = content_of(kept);
  if (!aside) return;
  std::string wanted;
  try {
    wanted = weights_of_record(path);
  } catch (const c10::ValueError&) {
    return;  // whoever reads the record says what is wrong with it
  }
  const auto content = content_of(weights);
  std::error_code error;
  const bool needed = fingerprint(*aside) == wanted && !(content && fingerprint(*content) == wanted);
  needed ? fs::rename(kept, weights, error) : void(fs::remove(kept, error));
}

}  // namespace prdp
