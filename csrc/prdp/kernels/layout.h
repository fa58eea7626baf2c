#pragma once
#include <cstdint>

#include "prdp/kernels/vector.h"

namespace prdp::kernels {

/// Where the values of one sample lie in padded memory: planes of rows of `nx` values, with zeros behind each row, and
/// before and behind the whole. The planes are those of a grid in three dimensions, or the fields of a state.
template <class T>
struct Layout {
  int64_t planes, rows, nx;
  int64_t row, plane;  // from one row, or plane, to the next
  int64_t halo;        // zeros before and behind

  /// Fields whose rows need no zero between them, such as the channels of a state; a matrix has one of one row.
  static Layout of_fields(int64_t fields, int64_t rows, int64_t nx) {
    const int64_t row = round_up_to_lanes<T>(nx);
    return {fields, rows, nx, row, rows * row, kLanes<T>};
  }
  int64_t unknowns() const { return planes * rows * nx; }
  int64_t length() const { return planes * plane; }

  /// dst = scale·src, from a contiguous sample into padded memory; and back.
  void load(const T* src, T scale, T* dst) const {
    for (int64_t z = 0; z < planes; ++z)
      for_each_run_of_rows(rows, nx, [&](int64_t r, int64_t end) {
        loops<T>().copy_rows(scale, src + (z * rows + r) * nx, nx, dst + z * plane + r * row, row, end - r, nx);
      });
  }
  void store(const T* src, T scale, T* dst) const {
    for (int64_t z = 0; z < planes; ++z)
      for_each_run_of_rows(rows, nx, [&](int64_t r, int64_t end) {
        loops<T>().copy_rows(scale, src + z * plane + r * row, row, dst + (z * rows + r) * nx, nx, end - r, nx);
      });
  }
};

}  // namespace prdp::kernels
