#pragma once
#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

#include "prdp/kernels/loops.h"
#include "prdp/threads/interruption.h"

namespace prdp::kernels {

/// B_z ⊗ B_y ⊗ B_x on a contiguous field (nz, ny, nx): one small dense product along each axis.
template <class T>
class AxisProducts {
 public:
  using Matrix = Eigen::Matrix<T, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
  using Matrices = std::array<Matrix, 3>;  // z first; a single entry for an axis that the grid does not have

  explicit AxisProducts(const Matrices& along)
      : along_(along), transposed_({along[0].transpose(), along[1].transpose(), along[2].transpose()}) {}

  /// field ← B field, or Bᵀ field; `other` is memory of the same size.
  void apply(std::vector<T>& field, std::vector<T>& other, bool transposed) const {
    const auto& b = transposed ? transposed_ : along_;
    const auto& of_rows = transposed ? along_[2] : transposed_[2];  // x is the last axis: (B_x vᵀ)ᵀ = v B_xᵀ
    const int64_t nz = b[0].rows(), ny = b[1].rows(), nx = b[2].rows();
    multiply(field.data(), of_rows.data(), other.data(), nz * ny, nx, nx);
    for (int64_t z = 0; z < nz; ++z)
      multiply(b[1].data(), other.data() + z * ny * nx, field.data() + z * ny * nx, ny, ny, nx);
    if (nz == 1) return;
    multiply(b[0].data(), field.data(), other.data(), nz, nz, ny * nx);
    field.swap(other);
  }

  int64_t bytes() const {
    int64_t entries = 0;
    for (const auto& matrix : along_) entries += 2 * int64_t{matrix.size()};
    return entries * static_cast<int64_t>(sizeof(T));
  }

 private:
  /// out = a b, with looks for an interruption in between.
  static void multiply(const T* a, const T* b, T* out, int64_t rows, int64_t inner, int64_t columns) {
    const int64_t work = inner * columns, each = std::max<int64_t>((int64_t{1} << 26) / std::max<int64_t>(work, 1), 16);
    for (int64_t first = 0; first < rows; first += each) {
      const int64_t count = std::min(each, rows - first);
      interruption::Watch::local().spend(count * work);
      loops<T>().multiply({a + first * inner, b, out + first * columns, count, inner, columns});
    }
  }

  Matrices along_, transposed_;
};

}  // namespace prdp::kernels
