#pragma once
#include "prdp/kernels/coarsening.h"
#include "prdp/kernels/stencil_fields.h"

namespace prdp::kernels {

/// The indices of a field that has a ring of one point around the grid.
struct RingedGrid {
  int64_t ny, nx;  // with the ring

  explicit RingedGrid(const StencilGrid& grid) : ny(grid.shape[1] + 2), nx(grid.shape[2] + 2) {}
  static int64_t size(const StencilGrid& grid) {
    return (grid.shape[0] + 2) * (grid.shape[1] + 2) * (grid.shape[2] + 2);
  }
  int64_t at(int64_t z, int64_t y, int64_t x) const { return ((z + 1) * ny + y + 1) * nx + x + 1; }
};

/// The weights with which points between two coarse points of an axis take the one before and the one after: fields
/// over all fine points (unused at the coarse ones) with a ring, which holds the other end of a periodic axis, else
/// zeros.
template <class T>
struct Weights {
  Field<T> left, right;
};

/// The interpolation and the restriction along an axis that belong to an operator (black-box multigrid, Dendy 1982, one
/// axis at a time). Of a symmetric one they are the same; else interpolation comes from the symmetric part and
/// restriction from the transpose (Dendy 1983).
template <class T>
struct AxisTransfer {
  Weights<T> interpolation, restriction;
};
template <class T>
AxisTransfer<T> make_transfer(const StencilFields<T>& a, int axis, bool symmetric);

}  // namespace prdp::kernels
