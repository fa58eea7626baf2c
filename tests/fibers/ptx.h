#pragma once
#include <bit>
#include <limits>
#include <type_traits>

#include "fibers.h"

/// What the instructions of PTX do, for the C++ that ptx.py makes of them. A register holds bits; an instruction says
/// of what type they are.
namespace {

/// The bits of a register as a T: the pattern of a float, or an integer cut to T.
template <class T, class R>
T as(R bits) {
  if constexpr (std::is_same_v<T, R>) return bits;
  else if constexpr (std::is_floating_point_v<T> && sizeof(T) == sizeof(R)) return std::bit_cast<T>(bits);
  else return static_cast<T>(bits);
}
/// A T as the bits of a register R; integers with a sign are extended.
template <class R, class T>
R to_register(T value) {
  if constexpr (std::is_floating_point_v<T> && !std::is_same_v<T, R>) return std::bit_cast<R>(value);
  else return static_cast<R>(value);
}

template <class T>
T load(uint64_t address) {
  T value;
  std::memcpy(&value, reinterpret_cast<const void*>(address), sizeof(T));
  return value;
}
template <class T>
void store(uint64_t address, T value) {
  std::memcpy(reinterpret_cast<void*>(address), &value, sizeof(T));
}
/// Of what other blocks may have written, for which a thread may wait.
template <class T>
T load_of_others(uint64_t address) {
  std::this_thread::yield();
  return *reinterpret_cast<const volatile T*>(address);
}
template <class T>
T magnitude(T v) {
  if constexpr (std::is_floating_point_v<T>) return std::fabs(v);
  else return v < 0 ? -v : v;
}
// Shifts by as many bits as there are, or more, leave zero or the sign.
template <class T>
T shift_left(T v, uint32_t n) {
  return n >= 8 * sizeof(T) ? T(0) : static_cast<T>(v << n);
}
template <class T>
T shift_right(T v, uint32_t n) {
  constexpr uint32_t most = 8 * sizeof(T);
  if (n >= most) return v < 0 ? T(-1) : T(0);
  return static_cast<T>(v >> n);
}
/// Half of the 64 bits of b and a, shifted by at most 31.
inline uint32_t funnel_left(uint32_t a, uint32_t b, uint32_t n) {
  return static_cast<uint32_t>((uint64_t{b} << 32 | a) << (n & 31) >> 32);
}
inline uint32_t funnel_right(uint32_t a, uint32_t b, uint32_t n) {
  return static_cast<uint32_t>((uint64_t{b} << 32 | a) >> (n & 31));
}
/// NaN gives way to a number.
template <class T>
T least(T a, T b) {
  if constexpr (std::is_floating_point_v<T>) return std::fmin(a, b);
  else return a < b ? a : b;
}
template <class T>
T most(T a, T b) {
  if constexpr (std::is_floating_point_v<T>) return std::fmax(a, b);
  else return a > b ? a : b;
}
/// A number becomes an integer as on a GPU: beyond the ends the last one; NaN zero, or where one of the two has 64
/// bits, the highest bit alone.
template <class To, class From>
To to_integer(From v) {
  if (std::isnan(v))
    return sizeof(From) < 8 && sizeof(To) < 8 ? To(0)
                                              : static_cast<To>(std::make_unsigned_t<To>(1) << (8 * sizeof(To) - 1));
  if (v <= static_cast<From>(std::numeric_limits<To>::min())) return std::numeric_limits<To>::min();
  if (v >= static_cast<From>(std::numeric_limits<To>::max())) return std::numeric_limits<To>::max();
  return static_cast<To>(v);
}
/// n bits of v, the lowest of which is number `first`.
inline uint32_t bits_of(uint32_t v, uint32_t first, uint32_t n) {
  const uint64_t mask = n >= 32 ? ~uint64_t{0} : (uint64_t{1} << n) - 1;
  return static_cast<uint32_t>((first >= 32 ? 0 : v >> first) & mask);
}
/// b with n bits of a from number `first` on.
template <class T>
T with_bits(T a, T b, uint32_t first, uint32_t n) {
  constexpr uint32_t most = 8 * sizeof(T);
  const T ones = n >= most ? ~T(0) : static_cast<T>((T(1) << n) - 1);
  return first >= most ? b : static_cast<T>((b & ~(ones << first)) | ((a & ones) << first));
}
/// Four of the eight bytes of b and a, or of their signs, each chosen by four bits.
inline uint32_t permuted(uint32_t a, uint32_t b, uint32_t by) {
  const uint64_t bytes = uint64_t{b} << 32 | a;
  uint32_t made = 0;
  for (int k = 0; k < 4; ++k) {
    const uint32_t which = by >> 4 * k & 15;
    uint32_t byte = static_cast<uint32_t>(bytes >> 8 * (which & 7)) & 255;
    if (which & 8) byte = byte & 128 ? 255 : 0;
    made |= byte << 8 * k;
  }
  return made;
}

}  // namespace
