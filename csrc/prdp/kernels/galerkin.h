#pragma once
#include "prdp/kernels/interpolation_weights.h"

/// A on the next coarser grid, R A P: P interpolates and R restricts along one axis (interpolation_weights.h), and
/// every second point of the axis is dropped. The coarse points are the odd ones of an axis that ends with zeros, and
/// the even ones of a periodic axis, whose first and last point are both coarse if their number is odd.
namespace prdp::kernels {

/// R A P along the axis.
template <class T>
StencilFields<T> galerkin_product(const StencilFields<T>& a, int axis, const AxisTransfer<T>& transfer);

/// Whether A = Aᵀ, to the last bit.
template <class T>
bool is_symmetric(const StencilFields<T>& a);

}  // namespace prdp::kernels
