#include "prdp_experiments/files/record_keys.h"

#include <c10/util/Exception.h>

#include <cmath>
#include <functional>
#include <vector>

#include "prdp/solvers/solver.h"
#include "prdp_experiments/files/count_limit.h"

/// Every key of a record is declared here, once.
namespace prdp {

namespace {

template <class... Words>
[[noreturn]] void wrong(const std::string& key, const Words&... words) {
  TORCH_CHECK_VALUE(false, "its key '", key, "' ", words...);
}

/// What is expected of a value; it raises ValueError with the key otherwise.
using Check = std::function<void(const Json&, const std::string& key)>;
struct Key {
  const char* name;
  Check check;
  bool optional = false;
};

void expect(bool holds, const std::string& key, const Json& found, const char* expected) {
  if (!holds) wrong(key, "is of type ", found.type_name(), ", expected ", expected);
}

void is_text(const Json& value, const std::string& key) { expect(value.is_string(), key, value, "text"); }
void is_text_or_none(const Json& value, const std::string& key) {
  expect(value.is_string() || value.is_null(), key, value, "text or null");
}
void is_table(const Json& value, const std::string& key) { expect(value.is_object(), key, value, "a table"); }

Check whole(int64_t least, int64_t most) {
  return [=](const Json& value, const std::string& key) {
    expect(value.is_number_integer(), key, value, "a whole number");
    const bool fits = !value.is_number_unsigned() || value.get<uint64_t>() <= static_cast<uint64_t>(most);
    if (!fits || value.get<int64_t>() < least || value.get<int64_t>() > most)
      wrong(key, "is ", value.dump(), ", expected ", least, " to ", most);
  };
}

void is_real(const Json& value, const std::string& key) {
  expect(value.is_number(), key, value, "a number");
  if (!(value.get<double>() >= 0.0)) wrong(key, "is ", value.dump(), ", expected a number >= 0");
}
/// NaN is written as null.
void is_real_or_nan(const Json& value, const std::string& key) {
  if (!value.is_null()) is_real(value, key);
}

void is_backward(const Json& value, const std::string& key) {
  is_text(value, key);
  backward_from_name(value.get_ref<const std::string&>());
}

/// The keys of a table, no other ones, in any order.
Check table(std::vector<Key> keys) {
  return [keys = std::move(keys)](const Json& value, const std::string& key) {
    is_table(value, key);
    const auto full = [&](const std::string& name) { return key.empty() ? name : key + "." + name; };
    for (const auto& [name, check, optional] : keys) {
      const auto found = value.find(name);
      if (found != value.end()) check(*found, full(name));
      else if (!optional) wrong(full(name), "is missing");
    }
    for (const auto& [name, entry] : value.items()) {
      bool known = false;
      for (const auto& one : keys) known = known || name == one.name;
      if (!known) wrong(full(name), "is unknown");
    }
  };
}

Check list(Check each) {
  return [each = std::move(each)](const Json& value, const std::string& key) {
    expect(value.is_array(), key, value, "a list");
    for (const auto& one : value) each(one, key);
  };
}

constexpr auto kLargest = std::numeric_limits<int64_t>::max();

const Check& record_keys() {
  static const auto counted = whole(0, kLargest), costs = list(is_real);
  static const auto curves = table({{"update_loss", costs},
                                    {"metric", list(is_real_or_nan)},
                                    {"error", list(is_real_or_nan)},
                                    {"max_iter", list(counted)},
                                    {"budget", list(counted)},
                                    {"iterations", costs},
                                    {"operator_applications", costs},
                                    {"adjoint_applications", costs},
                                    {"rtol", costs},
                                    {"failed", list(counted)},
                                    {"seconds", costs},
                                    {"diverged", is_text, true},
                                    {"warning", is_text, true}});
  static const auto settings = table({{"scene", is_text},
                                      {"text", is_text},
                                      {"backward", is_backward},
                                      {"intervals", whole(1, kMostCounted)},
                                      {"data", is_text, true},
                                      {"network", is_text, true},
                                      {"weights", is_text, true}});
  static const auto all = table({{"label", is_text},
                                 {"seed", whole(0, kMostCounted)},
                                 {"settings", settings},
                                 {"versions", is_table},
                                 {"machine", is_table},
                                 {"commit", is_text_or_none, true},
                                 {"command", is_text},
                                 {"folder", is_text, true},
                                 {"curves", curves},
                                 {"weights", is_text, true},
                                 {"fingerprint", is_text}});
  return all;
}

/// One entry per interval, one more for what is observed before the first, and as many updates in each interval.
void check_lengths(const Json& record) {
  const auto& curves = record["curves"];
  const auto done = curves["seconds"].size();
  if (done < 1 || done > record["settings"]["intervals"].get<size_t>())
    wrong("curves.seconds", "has ", done, " entries, expected 1 to the number of intervals");
  for (const auto& [name, values] : curves.items()) {
    if (!values.is_array() || name == "update_loss") continue;
    const auto expected = done + (name == "metric" || name == "error");
    if (values.size() != expected) wrong("curves." + name, "has ", values.size(), " entries, expected ", expected);
  }
  const auto updates = curves["update_loss"].size();
  if (!curves.contains("diverged") && (updates < done || updates % done != 0))
    wrong("curves.update_loss", "has ", updates, " entries, expected as many in each of ", done, " intervals");
}

/// Only a training that has diverged ends with NaN.
void check_known(const Json& record) {
  const auto& curves = record["curves"];
  for (const char* name : {"metric", "error"}) {
    const auto& values = curves[name];
    const size_t known = curves.contains("diverged") ? values.size() - 1 : values.size();
    for (size_t i = 0; i < known; ++i)
      if (values[i].is_null() && !(curves.contains("diverged") && values.size() == 2))
        wrong(std::string("curves.") + name, "holds null, and the training has not diverged there");
  }
}

}  // namespace

Json parse_shallow(std::string_view text) {
  constexpr int kDeepest = 16;
  struct TooDeep {};
  try {
    return Json::parse(text, [](int depth, Json::parse_event_t, Json&) {
      if (depth > kDeepest) throw TooDeep{};
      return true;
    });
  } catch (const TooDeep&) {
    TORCH_CHECK_VALUE(false, "its values are nested more than ", kDeepest, " deep");
  } catch (const Json::exception&) {
    TORCH_CHECK_VALUE(false, "it is not JSON");
  }
}

void check_training(const Json& record) {
  record_keys()(record, "");
  check_lengths(record);
  check_known(record);
}

}  // namespace prdp
