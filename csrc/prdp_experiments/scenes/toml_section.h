#pragma once
#include <c10/util/Exception.h>

#include <algorithm>
#include <cmath>
#include <map>
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
#include <toml++/impl/forward_declarations.h>
#include <toml++/impl/preprocessor.h>
#undef TOML_UNREACHABLE
#define TOML_UNREACHABLE \
  return {}
#include <toml++/impl/unicode.h>
#undef TOML_UNREACHABLE
#define TOML_UNREACHABLE prdp::refuse_broken_toml()
#include <toml++/toml.h>
#pragma pop_macro("NDEBUG")

#include "prdp_experiments/scenes/device.h"
#include "prdp_experiments/scenes/scene.h"
#include "prdp_experiments/scenes/scene_key.h"

namespace prdp {

/// The tables of a scene. ValueError with the line where it is no TOML.
inline toml::table parse_toml(const std::string& text, const std::string& path) {
  // toml++ ends the process on tables nested a hundred thousand deep; a file of this size cannot hold so many.
  constexpr size_t kLongest = 65536;
  TORCH_CHECK_VALUE(text.size() <= kLongest, "scene: '", path, "' has ", text.size(), " bytes; a scene has at most ",
                    kLongest);

  try {
    return toml::parse(text, path);
  } catch (const toml::parse_error& error) {
    TORCH_CHECK_VALUE(false, path, ":", error.source().begin.line, ": ", error.description());
  } catch (const BrokenToml&) {
    TORCH_CHECK_VALUE(false, path,
                      ": not a TOML file; a key or the name of a table has a character that it cannot have");
  }
  return {};
}

/// One table of a TOML file while it is read. KeyRecorder has the same functions, so that one declaration of a key
/// serves the reader and the documentation. Every key that is asked for is an allowed one; finish() refuses the others.
class TomlSection {
 public:
  TomlSection(const toml::table& table, std::string file, std::string name)
      : table_(table), file_(std::move(file)), name_(std::move(name)) {}

  /// Reads an inner table by read(its section, scene).
  template <class Read>
  void section(Scene& scene, Read read, const Key& key) {
    if (!given(key)) return refuse_now(key);
    const auto* inner = table_[key.name].as_table();
    if (!inner) fail(key.name, "expected a table");
    TomlSection section(*inner, file_, full(key.name));
    read(section, scene);
    section.finish();
  }
  /// Reads an inner table, or a text in its place.
  template <class Read>
  void section_or_text(Scene& scene, std::string& target, Read read, const char* form, const Key& key) {
    if (!table_[key.name].is_string()) return section(scene, read, key);
    text(target, key);
    if (target.empty()) fail(key.name, std::string("expected a table, or \"") + form + '"');
  }
  void text(std::string& target, const Key& key) {
    if (given(key)) target = value<std::string>(key.name, "a string");
  }
  void choice(std::string& target, const Choices& choices, const Key& key) {
    choice(target, [](const std::string& name) { return name; }, choices, key);
  }
  template <class T, class FromName>
  void choice(T& target, FromName from_name, const Choices& choices, const Key& key) {
    if (!given(key)) return refuse_now(key);
    const auto chosen = value<std::string>(key.name, "a string");
    std::ostringstream allowed;
    for (const auto& [name, when] : choices) {
      if (name == chosen) {
        if (!when.holds) fail(key.name, "'" + chosen + "' is " + when.words);
        target = from_name(chosen);
        return;
      }
      if (!when.holds) continue;
      allowed << (allowed.tellp() > 0 ? ", " : "") << name;
    }
    fail(key.name, "unknown name '" + chosen + "'; allowed: " + allowed.str());
  }
  void device(at::Device& target, const Key& key) {
    if (!given(key)) return;
    const auto name = value<std::string>(key.name, "a string");
    const auto found = device_from_name(name);
    if (!found) fail(key.name, "unknown name '" + name + "'; allowed: " + kDeviceNames);
    target = *found;
  }
  void flag(bool& target, const Key& key) {
    if (!given(key)) return;
    if (!table_[key.name].is_boolean()) fail(key.name, "expected true or false");
    target = table_[key.name].value_or(target);
  }
  template <class T>
  void at_least(T& target, double least, const Key& key) {
    if (!given<T>(key)) return;
    const double x = number(key.name);
    if (x < least) fail(key.name, bound(">=", least, x));
    target = x;
  }
  template <class T>
  void above(T& target, double least, const Key& key) {
    if (!given<T>(key)) return;
    const double x = number(key.name);
    if (!(x > least)) fail(key.name, bound(">", least, x));
    target = x;
  }
  /// In (0, 1].
  template <class T>
  void share(T& target, const Key& key) {
    if (!given<T>(key)) return;
    above(target, 0.0, key);
    if (number(key.name) > 1.0) fail(key.name, bound("<=", 1.0, number(key.name)));
  }
  template <class T>
  void whole(T& target, const Least<int64_t>& least, const Key& key) {
    if (!given<T>(key)) return;
    const auto k = value<int64_t>(key.name, "a whole number");
    if (k < least.value) fail(key.name, bound(">=", least.value, k));
    target = k;
  }
  /// A whole number that costs are multiples of.
  template <class T>
  void count(T& target, int64_t least, const Key& key) {
    int64_t k = least;
    whole(k, least, key);
    if (k > kMostCounted) fail(key.name, bound("<=", kMostCounted, k));
    if (key.when.holds) target = k;
  }
  void wholes(std::vector<int64_t>& target, int64_t least, const Key& key) {
    if (!given(key)) return;
    target = values<int64_t>(key.name, "whole numbers");
    for (const auto k : target)
      if (k < least) fail(key.name, bound(">=", least, k));
  }
  void numbers(std::vector<double>& target, const Key& key) {
    if (given(key)) target = values<double>(key.name, "numbers");
  }
  /// A number > 0 for each axis, or one for all of them. They are left out where all are 1.
  void sides(std::vector<double>& target, size_t axes, const Key& key) {
    if (!given(key)) return;
    if (table_[key.name].is_array()) target = values<double>(key.name, "numbers");
    else target.assign(axes, value<double>(key.name, "a number, or a list of numbers"));
    if (target.size() != axes) fail(key.name, "expected one number, or one per axis");
    for (const double x : target)
      if (!(x > 0.0) || !std::isfinite(x)) fail(key.name, bound(">", 0.0, x) + " and be finite");
    if (std::all_of(target.begin(), target.end(), [](double x) { return x == 1.0; })) target.clear();
  }
  /// A condition on what has been read already. It waits until no key is missing.
  void check(bool holds, const char* key, const std::string& expected) const {
    if (!holds && missing_.empty()) fail(key, expected);
  }

  /// Raises for keys that are missing, and for those that nobody asked for.
  void finish() const {
    refuse_missing();
    for (const auto& [key, node] : table_) {
      if (asked_.count(std::string(key.str()))) continue;
      if (const auto other = not_here_.find(std::string(key.str())); other != not_here_.end())
        fail(other->first.c_str(), other->second);
      std::ostringstream allowed;
      for (const auto& name : asked_) allowed << (allowed.tellp() > 0 ? ", " : "") << name;
      TORCH_CHECK_VALUE(false, file_, ":", key.source().begin.line, ": unknown name '", full(std::string(key.str())),
                        "'; allowed: ", allowed.str());
    }
  }

 private:
  std::string full(const std::string& key) const { return name_.empty() ? key : name_ + "." + key; }
  [[noreturn]] void fail(const char* key, const std::string& what) const {
    refuse_missing();  // what was read may be wrong for want of them
    const auto* node = table_.get(key);
    const auto line = node ? node->source().begin.line : table_.source().begin.line;
    TORCH_CHECK_VALUE(false, file_, ":", line, ": ", full(key), ": ", what);
  }
  /// Raises if keys are missing, all in one message.
  void refuse_missing() const {
    if (missing_.empty()) return;
    std::ostringstream present;
    for (const auto& [key, node] : table_) present << (present.tellp() > 0 ? ", " : "") << key.str();
    TORCH_CHECK_VALUE(false, file_, ":", table_.source().begin.line, ": ", c10::Join(", ", missing_),
                      ": missing; the table holds: ", table_.empty() ? "nothing" : present.str());
  }
  /// Of a key that others depend on: which come next, and what they may be.
  void refuse_now(const Key& key) const {
    if (key.when.holds && !key.optional) refuse_missing();
  }
  /// Whether there is a value to read. If the key applies, is not optional and is missing, refuse_missing() raises.
  template <class T = void>
  bool given(const Key& key) {
    if (!key.when.holds) {
      not_here_.emplace(key.name, key.when.words);
      return false;
    }
    asked_.insert(key.name);
    if (table_.contains(key.name)) return true;
    if (key.optional || is_optional<T>) return false;
    missing_.push_back(full(key.name));
    return false;
  }
  double number(const char* key) const {
    const double x = value<double>(key, "a number");
    if (!std::isfinite(x)) fail(key, "must be finite");
    return x;
  }
  template <class T>
  static std::string bound(const char* relation, T least, T got) {
    std::ostringstream text;
    text << "must be " << relation << " " << least << ", got " << got;
    return text.str();
  }
  template <class T>
  T value(const char* key, const char* expected) const {
    return read<T>(key, *table_.get(key), std::string("expected ") + expected);
  }
  template <class T>
  std::vector<T> values(const char* key, const char* expected) const {
    const auto* array = table_[key].as_array();
    if (!array) fail(key, std::string("expected a list of ") + expected + got(*table_.get(key)));
    std::vector<T> all;
    for (const auto& node : *array) all.push_back(read<T>(key, node, std::string("expected a list of ") + expected));
    return all;
  }
  template <class T>
  T read(const char* key, const toml::node& node, const std::string& expected) const {
    const auto x = node.value<T>();
    if (!x || node.is_boolean()) fail(key, expected + got(node));  // toml++ takes true for 1
    return *x;
  }

  /// ", got 2.5"; nothing for tables and dates.
  static std::string got(const toml::node& node) {
    std::ostringstream text;
    if (const auto* word = node.as_string()) text << ", got '" << word->get() << "'";
    else if (const auto* flag = node.as_boolean()) text << ", got " << (flag->get() ? "true" : "false");
    else if (node.is_number()) text << ", got " << *node.value<double>();
    else if (node.is_array()) text << ", got a list";
    return text.str();
  }

  const toml::table& table_;
  std::string file_, name_;
  std::set<std::string> asked_;
  std::vector<std::string> missing_;
  std::map<std::string, std::string> not_here_;  // keys of other scenes, and of which
};

}  // namespace prdp
