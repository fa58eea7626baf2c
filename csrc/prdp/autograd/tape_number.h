#pragma once
#include <c10/macros/Macros.h>

#include <cmath>
#include <cstdint>
#include <type_traits>
#include <vector>

namespace prdp {

/// Entries in the order in which they came. Cutting it back keeps the memory, as that happens in every iteration.
template <class Entry>
class Log {
 public:
  int32_t size() const { return size_; }
  Entry& operator[](int32_t i) { return entries_[i]; }
  const Entry& operator[](int32_t i) const { return entries_[i]; }
  /// Returns the place of the entry. Inline, as an entry that is written in parts and then copied as a whole waits for
  /// its own stores.
  C10_ALWAYS_INLINE int32_t push(const Entry& entry) {
    if (size_ == static_cast<int32_t>(entries_.size())) grow();
    entries_[size_] = entry;
    return size_++;
  }
  void cut_to(int32_t size) { size_ = size; }

 private:
  C10_NOINLINE void grow() { entries_.resize(2 * size_ + 32); }

  std::vector<Entry> entries_;
  int32_t size_ = 0;
};

/// A number of an iteration: up to two others that it was made of, with its derivatives with respect to them.
template <class T>
struct NumberNode {
  int32_t of[2];
  T derivative[2];
  T bar;  // its cotangent
};

/// A number that knows what it was made of; without a log, a constant.
template <class T>
struct TapeNumber {
  using Nodes = Log<NumberNode<T>>;

  T value{};
  int32_t node = -1;
  Nodes* log = nullptr;

  TapeNumber() = default;
  TapeNumber(T v) : value(v) {}
  template <class Other>
    requires std::is_arithmetic_v<Other>
  TapeNumber(Other v) : value(static_cast<T>(v)) {}
  /// A number that is not made of others.
  TapeNumber(T v, Nodes& nodes) : value(v), node(nodes.push({{-1, -1}, {}, T(0)})), log(&nodes) {}

  /// Of one or two numbers, with the derivatives with respect to them.
  static TapeNumber from(T value, const TapeNumber& a, T da, const TapeNumber& b = {}, T db = 0) {
    TapeNumber made(value);
    made.log = a.log ? a.log : b.log;
    if (made.log) made.node = made.log->push({{a.node, b.node}, {da, db}, T(0)});
    return made;
  }

  friend TapeNumber operator+(const TapeNumber& a, const TapeNumber& b) { return from(a.value + b.value, a, 1, b, 1); }
  friend TapeNumber operator-(const TapeNumber& a, const TapeNumber& b) { return from(a.value - b.value, a, 1, b, -1); }
  friend TapeNumber operator-(const TapeNumber& a) { return from(-a.value, a, -1); }
  friend TapeNumber operator*(const TapeNumber& a, const TapeNumber& b) {
    return from(a.value * b.value, a, b.value, b, a.value);
  }
  friend TapeNumber operator/(const TapeNumber& a, const TapeNumber& b) {
    const T ratio = a.value / b.value;
    return a.log || b.log ? from(ratio, a, 1 / b.value, b, -ratio / b.value) : TapeNumber(ratio);
  }
  friend TapeNumber sqrt(const TapeNumber& a) {
    const T root = std::sqrt(a.value);
    return a.log ? from(root, a, root > 0 ? T(0.5) / root : T(0)) : TapeNumber(root);
  }
};

}  // namespace prdp
