#pragma once

/// For the loops of the CPU (multigrid_loops.h) and for kernels (gpu/device/hierarchy.h): of internal linkage, as the
/// former are compiled once per instruction set.
namespace prdp::kernels {

namespace {

/// The Galerkin product along an axis at one coarse point, for one offset in the other axes: the coefficients that
/// couple it to three coarse points of the column at that offset, to its left, beside it, and to its right. The coarse
/// point lies on a fine one. Where the fine point before or after that is missing, the weights are those set here: 1
/// and 0, so that a coefficient is passed on to the coarse point that takes its place.
template <class T>
struct GalerkinPoint {
  T left, centre, right;

  // Of interpolation, to the fine points before and after, from the coarse points left and right of each; and of
  // restriction, from them to this coarse point.
  T before_left = 1, before_right = 0, after_left = 0, after_right = 1;
  T restrict_before = 0, restrict_after = 0;

  /// The coefficients of the three fine points with offset 0 along the axis.
  void take_centres(T before, T here, T after) {
    left = restrict_before * before * before_left;
    centre = restrict_before * before * before_right + here + restrict_after * after * after_left;
    right = restrict_after * after * after_right;
  }
  /// Those of the points before, here and after with offset -1 and 1 along the axis.
  void take_sides(const T (&lower)[3], const T (&upper)[3]) {
    left += restrict_before * lower[0] + lower[1] * before_left;
    centre += restrict_before * upper[0] + lower[1] * before_right + upper[1] * after_left + restrict_after * lower[2];
    right += upper[1] * after_right + restrict_after * upper[2];
  }
};

}  // namespace

}  // namespace prdp::kernels
