#pragma once
#include <c10/util/Exception.h>

#include <cmath>
#include <optional>
#include <set>
#include <sstream>
#include <string>
#include <vector>

/// Some files break what toml++ asserts or holds for unreachable, such as a table "[(]" and a letter that is not ASCII
/// behind a number: undefined behaviour in a release. Here they throw this. That toml++ looks for such a letter among
/// those of white space, where it does not find it, is no error.
namespace prdp {
struct BrokenToml {};
[[noreturn]] inline void refuse_broken_toml() { throw BrokenToml{}; }
}  // namespace prdp
#pragma push_macro("NDEBUG")
#undef NDEBUG
#define TOML_ASSERT(condition) ((condition) ? void() : prdp::refuse_broken_toml())
#include <toml++/impl/preprocessor.h>
#include <toml++/impl/forward_declarations.h>
#undef TOML_UNREACHABLE
#define TOML_UNREACHABLE return {}
#include <toml++/impl/unicode.h>
#undef TOML_UNREACHABLE
#define TOML_UNREACHABLE prdp::refuse_broken_toml()
#include <toml++/toml.h>
#pragma pop_macro("NDEBUG")

#include "prdp/scenes/scene.h"

namespace prdp {

/// One table of a TOML file while it is read. Every key that is asked for is an allowed one; what is
/// left over in the end is an error, so no list of names is kept beside the reading code.
class TomlSection {
 public:
  TomlSection(const toml::table& table, std::string file, std::string name)
      : table_(table), file_(std::move(file)), name_(std::move(name)) {}

  bool has(const char* key) {
    asked_.insert(key);
    return table_.contains(key);
  }
  TomlSection section(const char* key) {
    require(key);
    const auto* inner = table_[key].as_table();
    if (!inner) fail(key, "expected a table");
    return {*inner, file_, full(key)};
  }

  std::string text(const char* key) { return value<std::string>(key, "a string"); }
  std::string choice(const char* key, const std::vector<std::string>& allowed) {
    const auto chosen = text(key);
    std::ostringstream list;
    for (const auto& name : allowed) {
      if (name == chosen) return chosen;
      list << (list.tellp() > 0 ? ", " : "") << name;
    }
    fail(key, "unknown name '" + chosen + "'; allowed: " + list.str());
  }
  bool flag(const char* key, bool otherwise) {
    if (!has(key)) return otherwise;
    if (!table_[key].is_boolean()) fail(key, "expected true or false");
    return table_[key].value_or(otherwise);
  }
  double number(const char* key) {
    const double x = value<double>(key, "a number");
    if (!std::isfinite(x)) fail(key, "must be finite");
    return x;
  }
  double at_least(const char* key, double least) {
    const double x = number(key);
    if (x < least) fail(key, bound(">=", least, x));
    return x;
  }
  double above(const char* key, double least) {
    const double x = number(key);
    if (!(x > least)) fail(key, bound(">", least, x));
    return x;
  }
  int64_t whole(const char* key, int64_t least) {
    const auto k = value<int64_t>(key, "a whole number");
    if (k < least) fail(key, bound(">=", least, k));
    return k;
  }
  /// A whole number that costs are multiples of.
  int64_t count(const char* key, int64_t least) {
    const auto k = whole(key, least);
    if (k > kMostCounted) fail(key, bound("<=", kMostCounted, k));
    return k;
  }
  std::vector<int64_t> wholes(const char* key, int64_t least) {
    const auto all = values<int64_t>(key, "whole numbers");
    for (const auto k : all)
      if (k < least) fail(key, bound(">=", least, k));
    return all;
  }
  std::vector<double> numbers(const char* key) { return values<double>(key, "numbers"); }

  /// Raises for keys that nobody asked for.
  void finish() const {
    for (const auto& [key, node] : table_) {
      if (asked_.count(std::string(key.str()))) continue;
      std::ostringstream allowed;
      for (const auto& name : asked_) allowed << (allowed.tellp() > 0 ? ", " : "") << name;
      TORCH_CHECK_VALUE(false, file_, ":", key.source().begin.line, ": unknown name '",
                        full(std::string(key.str())), "'; allowed: ", allowed.str());
    }
  }
  [[noreturn]] void fail(const char* key, const std::string& what) const {
    const auto* node = table_.get(key);
    const auto line = node ? node->source().begin.line : table_.source().begin.line;
    TORCH_CHECK_VALUE(false, file_, ":", line, ": ", full(key), ": ", what);
  }

 private:
  std::string full(const std::string& key) const { return name_.empty() ? key : name_ + "." + key; }
  void require(const char* key) {
    if (has(key)) return;
    std::ostringstream present;
    for (const auto& [other, node] : table_) present << (present.tellp() > 0 ? ", " : "") << other.str();
    fail(key, "missing; the table holds: " + (table_.empty() ? "nothing" : present.str()));
  }
  template <class T>
  static std::string bound(const char* relation, T least, T got) {
    std::ostringstream text;
    text << "must be " << relation << " " << least << ", got " << got;
    return text.str();
  }
  template <class T>
  T value(const char* key, const char* expected) {
    require(key);
    return read<T>(key, *table_.get(key), std::string("expected ") + expected);
  }
  template <class T>
  std::vector<T> values(const char* key, const char* expected) {
    require(key);
    const auto* array = table_[key].as_array();
    if (!array) fail(key, std::string("expected a list of ") + expected);
    std::vector<T> all;
    for (const auto& node : *array) all.push_back(read<T>(key, node, std::string("expected a list of ") + expected));
    return all;
  }
  template <class T>
  T read(const char* key, const toml::node& node, const std::string& expected) const {
    const auto x = node.value<T>();
    if (!x || node.is_boolean()) fail(key, expected);  // toml++ takes true for 1
    return *x;
  }

  const toml::table& table_;
  std::string file_, name_;
  std::set<std::string> asked_;
};

}  // namespace prdp
