#pragma once
#include <cmath>
#include <limits>

namespace prdp::kernels {

/// Power of two s with s·magnitude in [1, 2) (near the subnormals, as close as s and 1/s allow).
template <class T>
T power_of_two_scale(T magnitude) {
  constexpr int limit = std::numeric_limits<T>::max_exponent - 2;
  int exponent = std::ilogb(magnitude);
  exponent = exponent > limit ? limit : exponent < -limit ? -limit : exponent;
  return std::ldexp(T(1), -exponent);
}

/// The power of two that brings an operator whose largest entry has this magnitude to the order of one; 1 if it is
/// not far from there.
template <class T>
T scale_of_operator(T magnitude) {
  constexpr int far = 8;
  if (!std::isfinite(magnitude) || magnitude == T(0) || std::abs(std::ilogb(magnitude)) <= far) return 1;
  return power_of_two_scale(magnitude);
}

}  // namespace prdp::kernels
