#pragma once
#include <optional>
#include <string>
#include <vector>

namespace prdp {

/// A condition on the rest of the scene, and the words in which the documentation states it.
struct When {
  bool holds = true;
  std::string words{};

  When operator&&(const When& other) const { return {holds && other.holds, words + ", " + other.words}; }
};

/// A key of a scene file, as the reader declares it. The call that reads it adds type and bounds, and the member
/// that it is read into adds the default.
struct Key {
  const char* name;
  const char* means;
  const char* unit = "";
  When when{};            // in other scenes, the key is an error
  bool optional = false;  // a missing key keeps the member's value; a key of a std::optional is always optional
};

/// One of the names that a key takes.
struct Choice {
  Choice(const char* name, When when = {}) : name(name), when(std::move(when)) {}

  const char* name;
  When when;
};
using Choices = std::vector<Choice>;

/// A bound that is the value of another key, for which the documentation needs that key's name.
template <class T>
struct Least {
  Least(T value, std::string words = {}) : value(value), words(std::move(words)) {}

  T value;
  std::string words;
};

template <class T>
constexpr bool is_optional = false;
template <class T>
constexpr bool is_optional<std::optional<T>> = true;

}  // namespace prdp
