#pragma once
#include <sstream>
#include <string>
#include <vector>

#include "prdp_experiments/scenes/scene.h"
#include "prdp_experiments/scenes/scene_key.h"

namespace prdp {

/// Writes down the keys that the reader declares: it has the functions of TomlSection, reads nothing, and enters every
/// key, whether it applies or not.
class KeyRecorder {
 public:
  KeyRecorder(std::vector<SceneKey>& keys, std::string table) : keys_(keys), table_(std::move(table)) {}

  template <class Read>
  void section(Scene& scene, Read read, const Key& key) {
    add(key, "table", "none", false);
    KeyRecorder inner(keys_, key.name);
    read(inner, scene);
  }
  template <class Read>
  void section_or_text(Scene& scene, const std::string&, Read read, const char* form, const Key& key) {
    section(scene, read, key);
    for (auto& entry : keys_)
      if (entry.table == table_ && entry.name == key.name) entry.value += c10::str(", or text `", form, "`");
  }
  void text(const std::string& target, const Key& key) { add(key, "text", quoted(target), false); }
  void choice(const std::string& target, const Choices& choices, const Key& key) {
    add(key, names(choices), quoted(target), false);
  }
  template <class T, class FromName>
  void choice(const T& target, FromName from_name, const Choices& choices, const Key& key) {
    for (const auto& [name, when] : choices)
      if (from_name(name) == target) return add(key, names(choices), quoted(name), false);
  }
  void device(const at::Device& target, const Key& key) { add(key, "`cpu`, `cuda`", quoted(target.str()), false); }
  void flag(bool target, const Key& key) { add(key, "`true`, `false`", target ? "`true`" : "`false`", false); }
  template <class T>
  void at_least(const T& target, double least, const Key& key) {
    add(key, "number >= " + written(least), written(target), is_optional<T>);
  }
  template <class T>
  void above(const T& target, double least, const Key& key) {
    add(key, "number > " + written(least), written(target), is_optional<T>);
  }
  template <class T>
  void share(const T& target, const Key& key) {
    add(key, "number in (0, 1]", written(target), is_optional<T>);
  }
  template <class T>
  void whole(const T& target, const Least<int64_t>& least, const Key& key) {
    const auto bound = least.words.empty() ? written(least.value) : least.words;
    add(key, "whole number >= " + bound, written(target), is_optional<T>);
  }
  template <class T>
  void count(const T& target, int64_t least, const Key& key) {
    whole(target, least, key);
  }
  void wholes(const std::vector<int64_t>& target, int64_t least, const Key& key) {
    add(key, "whole numbers >= " + written(least), written(target), false);
  }
  void numbers(const std::vector<double>& target, const Key& key) { add(key, "numbers", written(target), false); }
  void sides(const std::vector<double>&, size_t, const Key& key) {
    add(key, "number > 0, or a list of them", "1", false);
  }
  void check(bool, const char*, const char*) const {}

 private:
  void add(const Key& key, std::string value, std::string otherwise, bool optional) {
    SceneKey entry{table_, key.name, std::move(value), key.unit, {}, key.when.words, key.means};
    if (key.optional || optional) entry.otherwise = std::move(otherwise);
    keys_.push_back(std::move(entry));
  }
  /// `a`, `b` (only for x), with the names of one condition side by side.
  static std::string names(const Choices& choices) {
    std::ostringstream text;
    for (size_t i = 0; i < choices.size(); ++i) {
      const auto& words = choices[i].when.words;
      const bool last = i + 1 == choices.size();
      const bool ends = last || choices[i + 1].when.words != words;
      text << '`' << choices[i].name << '`';
      if (ends && !words.empty()) text << " (" << words << ')';
      if (!last) text << (ends ? "; " : ", ");
    }
    return text.str();
  }
  static std::string quoted(const std::string& text) { return text.empty() ? "none" : c10::str("`", text, "`"); }
  template <class T>
  static std::string written(const T& value) {
    std::ostringstream text;
    text << value;
    return text.str();
  }
  template <class T>
  static std::string written(const std::optional<T>&) {
    return "none";
  }
  template <class T>
  static std::string written(const std::vector<T>&) {
    return "none";
  }

  std::vector<SceneKey>& keys_;
  std::string table_;
};

}  // namespace prdp
