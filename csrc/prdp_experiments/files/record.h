#pragma once
#include <filesystem>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <string_view>

/// The record of a training, and the weights beside it.
namespace prdp {

using Json = nlohmann::ordered_json;

/// The record of a training at `path`; none where there is no file. Every key, type, range and length is checked, so
/// that a reader need not. Raises ValueError, naming the file, what is wrong and the remedy, for any other file.
std::optional<Json> read_training(const std::filesystem::path& path);

/// Where the weights of a record lie.
std::filesystem::path weights_of(const std::filesystem::path& record);
/// Replaces a record, an object of JSON as text, and its weights, if there are any: both, each whole, or neither.
/// Where a kill comes between the two, the record that it finds keeps its weights (read_weights()).
void write_training(const std::filesystem::path& path, std::string_view object, std::string_view weights);
/// The weights with this fingerprint, beside the record at `path`; none where there are none. Raises ValueError for
/// weights that are not these.
std::optional<std::string> read_weights(const std::filesystem::path& path, std::string_view fingerprint);
/// Puts the weights back that a killed write_training() has left aside, or removes them where nobody needs them. For
/// the process that writes to the folder.
void settle_weights(const std::filesystem::path& path);

}  // namespace prdp
