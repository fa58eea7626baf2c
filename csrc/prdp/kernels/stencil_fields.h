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

/// A row along x, and the index of its first point in a field.
struct GridRow {
  int64_t z, y, first;
};

/// Calls body(row) for all rows, on several threads if there are many.
template <class Body>
void for_each_row(const StencilGrid& grid, const Body& body) {
  const int64_t ny = grid.shape[1], nx = grid.shape[2];
  for_each_run_of_rows(grid.shape[0] * ny, nx, [&](int64_t begin, int64_t end) {
    for (int64_t r = begin; r < end; ++r) body(GridRow{r / ny, r % ny, r * nx});
  });
}

/// The points that an offset leads to from the points of a row.
class NeighboursOfRow {
 public:
  NeighboursOfRow(const StencilGrid& grid, const GridRow& row, const Offset& offset)
      : nx_(grid.shape[2]), along_x_(offset.along[2]), periodic_(grid.periodic[2]) {
    const int64_t z = neighbour(row.z, offset.along[0], grid.shape[0], grid.periodic[0]);
    const int64_t y = neighbour(row.y, offset.along[1], grid.shape[1], grid.periodic[1]);
    if (z >= 0 && y >= 0) first_ = (z * grid.shape[1] + y) * nx_;
  }
  /// Whether the row that the offset leads to lies in the grid.
  bool exist() const { return first_ >= 0; }
  /// The index of the neighbour of point i of the row; -1 where it lies beyond the grid.
  int64_t of(int64_t i) const {
    const int64_t x = exist() ? neighbour(i, along_x_, nx_, periodic_) : -1;
    return x < 0 ? -1 : first_ + x;
  }

 private:
  int64_t nx_, along_x_, first_ = -1;
  bool periodic_;
};

}  // namespace prdp::kernels
