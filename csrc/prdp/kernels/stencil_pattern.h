#pragma once
#include <cstdint>
#include <vector>

namespace prdp::kernels {

/// Cells along z, y and x; 0 along an axis that the grid does not have. Plain, for loops.cpp.
struct Offset {
  int64_t along[3];
  bool operator==(const Offset&) const = default;
};

/// The points (nz, ny, nx), with one point along an axis that the grid does not have, and which axes are
/// periodic; beyond the ends of the others every field is zero.
struct StencilGrid {
  int64_t dim;
  int64_t shape[3];
  bool periodic[3];
};

/// A coefficient that couples the two ends of a row: point `to` takes that of number `coefficient` times
/// the value that lies `from` after the point at the coefficient's offset from the row's first one.
struct StencilWrap {
  int64_t coefficient, to, from;
};

/// Which neighbours a stencil couples a point to. On a short periodic axis several offsets may lead to one
/// neighbour, and on a short axis with zeros beyond its ends an offset may lead nowhere.
struct StencilPattern {
  StencilPattern(const StencilGrid& on, const std::vector<Offset>& given);

  /// The point itself and its nearest neighbours.
  static std::vector<Offset> nearest_neighbours(int64_t dim);

  StencilGrid grid;
  bool nearest;                    // `offsets` are the nearest neighbours
  std::vector<Offset> offsets;     // distinct neighbours, the point itself first
  std::vector<int64_t> places;     // of each given offset: its number in `offsets`; -1: it leads nowhere
  std::vector<StencilWrap> wraps;  // of a row; only where others than the nearest neighbours are coupled
};

/// i + offset on an axis of n points, or -1 where that is nowhere. |offset| <= n.
inline int64_t neighbour(int64_t i, int64_t offset, int64_t n, bool periodic) {
  const int64_t j = i + offset;
  if (j >= 0 && j < n) return j;
  return !periodic ? -1 : j < 0 ? j + n : j - n;
}

}  // namespace prdp::kernels
