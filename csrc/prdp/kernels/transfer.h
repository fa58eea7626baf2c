#pragma once
#include <vector>

#include "prdp/kernels/interpolation_weights.h"
#include "prdp/kernels/layout.h"

namespace prdp::kernels {

/// A field, or several, on a grid of up to three axes in padded memory.
struct PaddedGrid {
  int64_t fields, shape[3];        // z, y, x
  int64_t field, plane, row;       // from one to the next

  /// As Layout has it; without `channels`, the planes of the layout are those of the grid.
  template <class T>
  static PaddedGrid of(const Layout<T>& layout, const StencilGrid& grid, bool channels) {
    const auto& [nz, ny, nx] = grid.shape;
    if (channels) return {layout.planes, {nz, ny, nx}, layout.plane, ny * layout.row, layout.row};
    return {1, {nz, ny, nx}, layout.length(), layout.plane, layout.row};
  }
  int64_t at(int64_t f, int64_t z, int64_t y) const { return f * field + z * plane + y * row; }
};

/// Restriction and interpolation along one axis, for fields in padded memory; the same for every field. Along the axis,
/// coarse points C and those between, b, take turns:
///
///     C b C b …  (C)   on a periodic axis, where the first C follows the last b, or the last C if their number is odd;
///     0 b C b C b 0    on any other, where zeros lie beyond the ends.
template <class T>
class Transfer {
 public:
  /// For the points of `grid`.
  Transfer(const StencilGrid& grid, int axis, const AxisTransfer<T>& weights, bool symmetric);

  /// The grid of the coarse points.
  const StencilGrid& coarse() const { return coarse_; }
  int64_t bytes() const;

  /// coarse = R fine, and fine += P coarse; or transposed, coarse = Pᵀ fine, and fine += Rᵀ coarse.
  void restrict(const PaddedGrid& from, const T* fine, const PaddedGrid& to, T* coarse, bool transposed) const;
  void add_interpolated(const PaddedGrid& from, const T* coarse, const PaddedGrid& to, T* fine, bool transposed) const;

 private:
  /// Weights of the points that are not coarse: for an axis of rows or planes a row for each; along x two values more
  /// per row, for what lies before the first and behind the last.
  struct Compressed {
    std::vector<T> left, right;
  };
  Compressed compress(const Weights<T>& weights) const;
  const Compressed& of_restriction(bool transposed) const {
    return transposed || restriction_.left.empty() ? interpolation_ : restriction_;
  }
  const Compressed& of_interpolation(bool transposed) const {
    return !transposed || restriction_.left.empty() ? interpolation_ : restriction_;
  }
  int64_t between() const { return fine_.shape[axis_] - coarse_.shape[axis_]; }
  /// The first weight of the row, or of the row between coarse rows, in `Compressed`.
  int64_t weights_at(int64_t z, int64_t y) const;

  template <class Body>
  void for_each_row(const PaddedGrid& grid, const Body& body) const;
  /// Makes each row of `out`: where the axis is x, by along_x(row of `in`, left, right, row of `out`), and else by
  /// across(i, row, w, weight, row of `out`), as restrict_row() and interpolate_row() take them.
  template <class AlongX, class Across>
  void make_rows(const PaddedGrid& from, const T* in, const PaddedGrid& to, T* out, const Compressed& w,
                 const AlongX& along_x, const Across& across) const;
  /// One row. Along x it is split into its coarse points and those between, and merged again; along another axis whole
  /// rows are combined.
  void restrict_along_x(const T* fine, const T* left, const T* right, T* coarse) const;
  void interpolate_along_x(const T* coarse, const T* left, const T* right, T* fine) const;
  /// Row j of the coarse grid along the axis, from row(i) of the fine one; weight(field, k) is that of the k-th row
  /// that is not coarse.
  template <class Row, class Weight>
  void restrict_row(int64_t j, const Row& row, const Compressed& w, const Weight& weight, T* coarse) const;
  /// Adds to row i of the fine grid, from row(j) of the coarse one.
  template <class Row, class Weight>
  void interpolate_row(int64_t i, const Row& row, const Compressed& w, const Weight& weight, T* fine) const;

  StencilGrid fine_, coarse_;
  int axis_;
  bool periodic_;
  int64_t first_coarse_, first_between_;  // points along the axis: coarse ones and others take turns
  Compressed interpolation_, restriction_;  // the latter is empty if it is the same
  std::vector<T> zeros_;                    // a row, for neighbours that are not there
};

}  // namespace prdp::kernels
