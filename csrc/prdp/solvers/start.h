#pragma once
#include <cmath>
#include <cstdint>
#include <limits>

#include "prdp/kernels/scales.h"
#include "prdp/solvers/verdicts.h"

/// The start of one sample, on the CPU or in a kernel of a GPU; of a batch of tensors: tensor_start.h.
namespace prdp {

/// Starts a space from α x0, where α = ⟨b, A x0⟩ / ⟨A x0, A x0⟩ makes the residual least, unless that is no better than
/// zero, or A x0 is rounding. From there on b() is the residual of the start, and what the method looks for is added
/// to it.
template <class Space>
void start_from(Space& space, const typename Space::Scalar* x0) {
  using T = typename Space::Scalar;
  const T magnitude = space.largest_given(x0);
  if (magnitude == T(0)) return;
  auto x = space.start(), product = space.scratch(), r = space.original_b();
  space.load(x0, kernels::power_of_two_scale(magnitude), x);
  if (space.is_singular()) {
    const T whole2 = space.dot(x, x);
    space.project_solution(x);
    if (only_rounding_is_left(space.dot(x, x), whole2, std::numeric_limits<T>::epsilon())) return;
  }
  space.apply(x, product);
  space.project(product);
  const T largest = space.largest_magnitude(product);
  if (std::isfinite(largest) && largest > T(0)) {
    const T scale = kernels::power_of_two_scale(largest);
    space.scale(scale, product);
    const T alpha = space.dot(space.b(), product) / space.dot(product, product);
    space.copy(space.b(), r);
    space.axpy(-alpha, product, r);
    space.scale(scale, x);
    space.scale(alpha, x);
    const T left2 = space.dot(r, r), b2 = space.b2();
    bool better = left2 < b2 && std::isfinite(space.largest_magnitude(x));
    if (better && left2 > b2 / 4)  // less is no rounding's doing
      better = start_gains_more_than_rounding<double>(
          b2, left2, space.unit_roundoff() * space.operator_norm()[0] * std::sqrt(space.dot(x, x)));
    if (better) space.shift_to_start(left2);
  }
  space.fill_zero(product);
}

}  // namespace prdp
