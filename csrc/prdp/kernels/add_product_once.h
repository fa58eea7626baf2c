#pragma once

namespace prdp::kernels {

namespace {

/// value + a b, rounded once where the processor can. Left to itself, the compiler does so in some loops only, and a
/// sum would depend on how many of its kind are formed side by side.
inline double add_product_once(double value, double a, double b) {
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
  return __builtin_fma(a, b, value);
#else
  return value + a * b;
#endif
}

}  // namespace

}  // namespace prdp::kernels
