#pragma once
#include <ATen/core/ATen_fwd.h>

#include <iomanip>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

#include "prdp_experiments/scenes/scene.h"
#include "prdp_experiments/scenes/scene_key.h"

namespace prdp {

/// Writes down what a scene holds for the keys that the reader declares, as one line. It has the functions of
/// TomlSection and reads nothing.
class KeyValues {
 public:
  KeyValues() { text_ << std::setprecision(17); }

  void text(const std::string& value, const Key& key) { write(value, key); }
  void choice(const std::string& value, const Choices&, const Key& key) { write(value, key); }
  void flag(bool value, const Key& key) { write(value, key); }
  template <class T>
  void at_least(const T& value, double, const Key& key) {
    write(value, key);
  }
  template <class T>
  void above(const T& value, double, const Key& key) {
    write(value, key);
  }
  template <class T>
  void share(const T& value, const Key& key) {
    write(value, key);
  }
  template <class T>
  void whole(const T& value, const Least<int64_t>&, const Key& key) {
    write(value, key);
  }
  template <class T>
  void count(const T& value, int64_t, const Key& key) {
    write(value, key);
  }
  void wholes(const std::vector<int64_t>& value, int64_t, const Key& key) { write(at::IntArrayRef(value), key); }
  void sides(const std::vector<double>& value, size_t, const Key& key) {
    for (const double x : value) write(x, key);
  }
  void check(bool, const char*, const char*) const {}

  std::string line() const { return text_.str(); }

 private:
  template <class T>
  void write(const T& value, const Key& key) {
    text_ << ", " << key.name << ' ' << value;
  }
  template <class T>
  void write(const std::optional<T>& value, const Key& key) {
    if (value) write(*value, key);
  }

  std::ostringstream text_;
};

}  // namespace prdp
