#pragma once
#include <memory>
#include <vector>

#include "prdp/kernels/stencil_sparsity.h"
#include "prdp/kernels/whole_vectors.h"

namespace prdp::kernels {

/// A stencil with neighbours at most one cell away, as contiguous fields (nz, ny, nx) of coefficients. What points
/// beyond the grid is kept: no product uses it, but the weights of interpolation need it.
template <class T>
struct StencilFields {
  explicit StencilFields(const StencilGrid& on) : grid(on) {}
  StencilFields(StencilFields&&) = default;  // a copy would point to the memory of the other
  StencilFields& operator=(StencilFields&&) = default;

  StencilGrid grid;
  /// By offset, 9 (z + 1) + 3 (y + 1) + x + 1; null where there is no such neighbour.
  const T* coefficients[27] = {};
  std::vector<Field<T>> memory{};  // of those that are not somebody else's

  static int place(const Offset& o) {
    return static_cast<int>(9 * (o.along[0] + 1) + 3 * (o.along[1] + 1) + o.along[2] + 1);
  }
  static Offset offset(int place) { return {{place / 9 - 1, place / 3 % 3 - 1, place % 3 - 1}}; }
  static constexpr int kCentre = 13;

  int64_t points() const { return grid.shape[0] * grid.shape[1] * grid.shape[2]; }
  /// A new field for this offset, to be filled.
  T* add(int place) {
    memory.emplace_back(points());
    coefficients[place] = memory.back().data();
    return memory.back().data();
  }
};

}  // namespace prdp::kernels
