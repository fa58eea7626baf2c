#pragma once
#if defined(__AVX512F__)
#include <immintrin.h>
#endif
#include <utility>

#include "prdp/kernels/loops.h"

/// One register of the instruction set that loops.cpp is being compiled for, by the vector extension of
/// GCC and Clang; included there only, and for the same reason all of internal linkage. What sums over
/// several vectors at once, or reads its neighbours, is written with it: plain loops of that kind are
/// not compiled into vector code.
namespace prdp::kernels {

namespace {

#if defined(__AVX512F__)
constexpr int64_t kRegisterBytes = 64;
#elif defined(__AVX__)
constexpr int64_t kRegisterBytes = 32;
#else
constexpr int64_t kRegisterBytes = 16;
#endif

template <class T>
struct RegisterOf {
  typedef T Type __attribute__((vector_size(kRegisterBytes)));
};
template <class T>
using Register = typename RegisterOf<T>::Type;

/// Values in a register; divides kLanes.
template <class T>
constexpr int kWidth = kRegisterBytes / sizeof(T);

template <class T>
Register<T> load(const T* p) {
  Register<T> v;
  __builtin_memcpy(&v, p, sizeof v);
  return v;
}
template <class T>
void store(T* p, const Register<T>& v) {
  __builtin_memcpy(p, &v, sizeof v);
}

/// kWidth lanes of (a, b), from number First on.
template <int First, class V, int... Lane>
V lanes_from(const V& a, const V& b, std::integer_sequence<int, Lane...>) {
  return __builtin_shufflevector(a, b, (First + Lane)...);
}
template <class T, int First>
Register<T> lanes_from(const Register<T>& a, const Register<T>& b) {
#if defined(__AVX512F__)  // GCC would take a permutation, which is slower
  const auto low = reinterpret_cast<__m512i>(a), high = reinterpret_cast<__m512i>(b);
  if constexpr (sizeof(T) == 4)
    return reinterpret_cast<Register<T>>(_mm512_maskz_alignr_epi32(0xffff, high, low, First));
  else return reinterpret_cast<Register<T>>(_mm512_maskz_alignr_epi64(0xff, high, low, First));
#else
  return lanes_from<First>(a, b, std::make_integer_sequence<int, kWidth<T>>());
#endif
}

/// The upper half of a vector added to its lower half.
template <class V, int... Lane>
auto fold(const V& v, std::integer_sequence<int, Lane...>) {
  return __builtin_shufflevector(v, v, Lane...) +
         __builtin_shufflevector(v, v, (static_cast<int>(sizeof...(Lane)) + Lane)...);
}
template <class T, class V>
T sum_lanes(const V& v) {
  constexpr int lanes = sizeof(V) / sizeof(T);
  if constexpr (lanes == 2) return v[0] + v[1];
  else return sum_lanes<T>(fold(v, std::make_integer_sequence<int, lanes / 2>()));
}

}  // namespace

}  // namespace prdp::kernels
