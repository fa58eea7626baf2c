#pragma once

/// For the loops of the CPU (multigrid_loops.h) and for kernels (gpu/device/hierarchy.h): of internal linkage, as the
/// former are compiled once per instruction set.
namespace prdp::kernels {

namespace {

/// Galerkin products along an axis at a coarse point, with one offset in the other axes: the coefficients of the fine
/// points before it, there, and after it, with offset -1 (lower), 0 (centre) and 1 (upper) along the axis; the weights
/// with which these take the coarse points; and those with which the coarse point takes them.
template <class T>
struct CollapsedPoint {
  T left, centre, right;

  void take_centres(T before, T here, T after) {
    left = restrict_before * before * before_left;
    centre = restrict_before * before * before_right + here + restrict_after * after * after_left;
    right = restrict_after * after * after_right;
  }
  void take_sides(const T (&lower)[3], const T (&upper)[3]) {
    left += restrict_before * lower[0] + lower[1] * before_left;
    centre += restrict_before * upper[0] + lower[1] * before_right + upper[1] * after_left + restrict_after * lower[2];
    right += upper[1] * after_right + restrict_after * upper[2];
  }

  T before_left, before_right, after_left, after_right, restrict_before, restrict_after;
};

}  // namespace

}  // namespace prdp::kernels
