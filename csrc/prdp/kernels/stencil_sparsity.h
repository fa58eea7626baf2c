#pragma once
#include <cstdint>
#include <vector>

namespace prdp::kernels {

/// A neighbour's distance in cells along z, y and x; 0 along an axis that the grid does not have.
struct Offset {
  int64_t along[3];
  bool operator==(const Offset&) const = default;
};

/// The numbers of points (nz, ny, nx), 1 along an axis that the grid does not have, and which axes are periodic. Beyond
/// the ends of the other axes every field is zero.
struct StencilGrid {
  int64_t dim;
  int64_t shape[3];
  bool periodic[3];
};

/// A coefficient that couples the two ends of a periodic row. Start at the row's first point and go by the offset of
/// `coefficient`: the value `from` points further on is what the coefficient multiplies at point `to` of the row.
struct StencilWrap {
  int64_t coefficient, to, from;
};

/// The neighbours that a stencil couples a point to. On a short periodic axis several offsets may lead to the same
/// neighbour. On a short axis with zeros beyond its ends an offset may lead nowhere.
struct StencilSparsity {
  StencilSparsity(const StencilGrid& on, const std::vector<Offset>& given);

  /// The point itself and its nearest neighbours.
  static std::vector<Offset> nearest_neighbours(int64_t dim);

  StencilGrid grid;
  bool nearest;                    // `offsets` are the nearest neighbours
  std::vector<Offset> offsets;     // distinct neighbours, the point itself first
  std::vector<int64_t> places;     // for each given offset, its index in `offsets`; -1 if it leads nowhere
  std::vector<StencilWrap> wraps;  // of a row; empty if only nearest neighbours are coupled
};

/// The index i + offset on an axis of n points, or -1 if it lies outside. Requires |offset| <= n.
inline int64_t neighbour(int64_t i, int64_t offset, int64_t n, bool periodic) {
  const int64_t j = i + offset;
  if (j >= 0 && j < n) return j;
  return !periodic ? -1 : j < 0 ? j + n : j - n;
}

}  // namespace prdp::kernels
