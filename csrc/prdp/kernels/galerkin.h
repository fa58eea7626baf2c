#pragma once
#include <vector>

#include "prdp/kernels/coarsening.h"
#include "prdp/kernels/stencil_fields.h"

/// Coarser grids by dropping every second point of one axis, and operators on them (black-box multigrid, Dendy 1982,
/// one axis at a time). The coarse points are the odd ones of an axis that ends with zeros, and the even ones of a
/// periodic axis, whose first and last point are both coarse if their number is odd.
namespace prdp::kernels {

/// How a point between two coarse points of an axis is made of them: fields over all fine points, of which those of
/// coarse points are not used, with a ring of one point around them.
template <class T>
struct Weights {
  Field<T> left, right;
};

/// The interpolation and the restriction along an axis that belong to an operator. Of a symmetric one they are the
/// same; else interpolation comes from the symmetric part and restriction from the transpose (Dendy 1983).
template <class T>
struct AxisTransfer {
  Weights<T> interpolation, restriction;
};
template <class T>
AxisTransfer<T> make_transfer(const StencilFields<T>& a, int axis, bool symmetric);

/// R A P along the axis.
template <class T>
StencilFields<T> galerkin_product(const StencilFields<T>& a, int axis, const AxisTransfer<T>& transfer);

/// Whether A = Aᵀ, to the last bit.
template <class T>
bool is_symmetric(const StencilFields<T>& a);

}  // namespace prdp::kernels
