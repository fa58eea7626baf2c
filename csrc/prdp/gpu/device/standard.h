#pragma once
/// What the text of a kernel uses of the standard library, which NVRTC has not: <array>, <cmath>, … are this file
/// there. The methods are the same text on the CPU, where they include the library's own.
using int64_t = long;
using int32_t = int;
using uint64_t = unsigned long;

#define PRDP_UNROLL _Pragma("unroll")
#define PRDP_NO_UNROLL _Pragma("unroll 1")
/// Functions that are not copied to where they are called: else a kernel takes a minute to compile.
#define PRDP_NOINLINE __noinline__
#define PRDP_SPIN \
  {               \
  }
#define PRDP_LEAVES_OUT(line) false
#define PRDP_BLOCK_MEMORY(name) extern __shared__ double name[]

namespace std {

using ::abs;
using ::cos, ::sin, ::sqrt, ::log, ::ceil, ::ilogb, ::ldexp;
using ::int32_t;
using ::int64_t;
using ::size_t;
using ::uint64_t;
inline bool isfinite(float x) { return ::isfinite(x); }
inline bool isfinite(double x) { return ::isfinite(x); }
inline bool isnan(double x) { return ::isnan(x); }

template <class T, T v>
struct integral_constant {
  static constexpr T value = v;
};
template <class A, class B>
struct is_same : integral_constant<bool, false> {};
template <class A>
struct is_same<A, A> : integral_constant<bool, true> {};
template <class A, class B>
concept same_as = is_same<A, B>::value;
template <class A, class B>
concept convertible_to = requires(A a) { static_cast<B>(a); };
template <class T>
T&& declval();

template <class T>
constexpr const T& min(const T& a, const T& b) {
  return b < a ? b : a;
}
template <class T>
constexpr const T& max(const T& a, const T& b) {
  return a < b ? b : a;
}
template <class T>
void swap(T& a, T& b) {
  T before = a;
  a = b;
  b = before;
}

template <class T>
struct numeric_limits;
template <>
struct numeric_limits<float> {
  static constexpr int max_exponent = 128;
  static constexpr float epsilon() { return 1.1920928955078125e-07f; }
  static constexpr float min() { return 1.1754943508222875e-38f; }
  static constexpr float denorm_min() { return 1.401298464324817e-45f; }
  static constexpr float infinity() { return __builtin_bit_cast(float, 0x7f800000); }
  static constexpr float quiet_NaN() { return __builtin_bit_cast(float, 0x7fffffff); }
};
template <>
struct numeric_limits<double> {
  static constexpr int max_exponent = 1024;
  static constexpr double epsilon() { return 2.220446049250313e-16; }
  static constexpr double min() { return 2.2250738585072014e-308; }
  static constexpr double denorm_min() { return 4.9406564584124654e-324; }
  static constexpr double infinity() { return __builtin_bit_cast(double, 0x7ff0000000000000L); }
  static constexpr double quiet_NaN() { return __builtin_bit_cast(double, 0x7fffffffffffffffL); }
};
template <>
struct numeric_limits<int64_t> {
  static constexpr int64_t max() { return 0x7fffffffffffffffLL; }
};

template <class T, size_t n>
struct array {
  using value_type = T;
  T values[n];
  T& operator[](size_t i) { return values[i]; }
  const T& operator[](size_t i) const { return values[i]; }
  T* begin() { return values; }
  T* end() { return values + n; }
  const T* begin() const { return values; }
  const T* end() const { return values + n; }
  static constexpr size_t size() { return n; }
};
template <class T, class... U>
array(T, U...) -> array<T, 1 + sizeof...(U)>;
// For structured bindings.
template <class T>
struct tuple_size;
template <size_t i, class T>
struct tuple_element;
template <class T, size_t n>
struct tuple_size<array<T, n>> : integral_constant<size_t, n> {};
template <class T>
struct tuple_size<const T> : tuple_size<T> {};
template <size_t i, class T, size_t n>
struct tuple_element<i, array<T, n>> {
  using type = T;
};
template <size_t i, class T>
struct tuple_element<i, const T> {
  using type = const typename tuple_element<i, T>::type;
};
template <size_t i, class T, size_t n>
T& get(array<T, n>& a) {
  return a.values[i];
}
template <size_t i, class T, size_t n>
const T& get(const array<T, n>& a) {
  return a.values[i];
}
template <size_t i, class T, size_t n>
T&& get(array<T, n>&& a) {
  return static_cast<T&&>(a.values[i]);
}

template <class I, class P>
bool none_of(I begin, I end, P p) {
  for (; begin != end; ++begin)
    if (p(*begin)) return false;
  return true;
}
template <class I, class V>
I find(I begin, I end, const V& value) {
  for (; begin != end && !(*begin == value); ++begin) {
  }
  return begin;
}

// Named, but not called there: what a method carries from one iteration to the next, for the CPU's tape, and the table
// of statuses.
template <class... T>
struct tuple {};
template <class... T>
tuple<T&...> tie(T&...) {
  return {};
}
template <class T>
struct vector;

}  // namespace std
