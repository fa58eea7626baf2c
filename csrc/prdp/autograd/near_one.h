#pragma once
#include <cmath>
#include <optional>
#include <vector>

#include "prdp/kernels/vector.h"

namespace prdp {

/// An operator for the loops to work with: the one given, or, where its entries are far from the order of
/// one, a power of two times it, so that no product of some of them over- or underflows. That changes no bit
/// of what does not. Kernels that cannot be scaled stay as they are.
template <class Kernel>
class NearOne {
 public:
  using T = typename Kernel::Scalar;

  explicit NearOne(const Kernel& given) : given_(given) {
    if constexpr (requires { given.scaled(T(1), memory_); }) {
      constexpr int far = 24;
      const T magnitude = given.magnitude();
      if (!std::isfinite(magnitude) || magnitude == T(0) || std::abs(std::ilogb(magnitude)) <= far) return;
      factor_ = kernels::power_of_two_scale(magnitude);
      scaled_.emplace(given.scaled(factor_, memory_));
    }
  }
  NearOne(const NearOne&) = delete;

  const Kernel& operator*() const { return scaled_ ? *scaled_ : given_; }
  /// *this = factor · the operator given.
  T factor() const { return factor_; }

 private:
  const Kernel& given_;
  T factor_ = 1;
  std::vector<T> memory_;
  std::optional<Kernel> scaled_;
};

}  // namespace prdp
