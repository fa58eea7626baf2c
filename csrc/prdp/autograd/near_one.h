#pragma once
#include <cmath>
#include <optional>
#include <vector>

#include "prdp/kernels/vector.h"

namespace prdp {

/// The operator for the loops. If the entries of the given one are far from the order of one, it is scaled by a power
/// of two, so that products of several entries neither overflow nor underflow. Other results do not change in any bit.
/// Kernels that cannot be scaled stay as they are.
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
