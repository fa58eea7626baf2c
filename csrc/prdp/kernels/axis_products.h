#pragma once
#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

#include "prdp/kernels/loops.h"
#include "prdp/threads/interruption.h"
#include "prdp/threads/share_rows.h"

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
    if (nz == 1) return multiply(b[1].data(), other.data(), field.data(), ny, ny, nx);
    in_turns(nz, 1, ny * ny * nx, [&](int64_t z, int64_t count) {
      for (const int64_t end = z + count; z < end; ++z)
        loops<T>().multiply({b[1].data(), other.data() + z * ny * nx, field.data() + z * ny * nx, ny, ny, nx});
    });
    multiply(b[0].data(), field.data(), other.data(), nz, nz, ny * nx);
    field.swap(other);
  }

  int64_t bytes() const {
    int64_t entries = 0;
    for (const auto& matrix : along_) entries += 2 * int64_t{matrix.size()};
    return entries * static_cast<int64_t>(sizeof(T));
  }

 private:
  /// out = a b
  static void multiply(const T* a, const T* b, T* out, int64_t rows, int64_t inner, int64_t columns) {
    constexpr int64_t tiles = 24;  // rows that make whole tiles of a product, whichever the loops
    in_turns(rows, tiles, inner * columns, [&](int64_t first, int64_t count) {
      loops<T>().multiply({a + first * inner, b, out + first * columns, count, inner, columns});
    });
  }
  /// Calls body(first, count) for runs of items, each of which takes so many products of numbers: in parts of a
  /// multiple of `least` items on several threads, with looks for an interruption in between.
  template <class Body>
  static void in_turns(int64_t items, int64_t least, int64_t work, const Body& body) {
    constexpr int64_t at_once = int64_t{1} << 26, worth_a_thread = int64_t{1} << 20;
    const auto parts_of = [&](int64_t products) { return std::max<int64_t>(products / (work * least), 1) * least; };
    const int64_t of_thread = parts_of(worth_a_thread),
                  each = std::max(parts_of(at_once), at::get_num_threads() * of_thread);
    for (int64_t first = 0; first < items; first += each) {
      const int64_t count = std::min(each, items - first);
      interruption::Watch::local().spend(count * work);
      share_rows::for_each((count + of_thread - 1) / of_thread, [&](int64_t part) {
        body(first + part * of_thread, std::min(of_thread, count - part * of_thread));
      });
    }
  }

  Matrices along_, transposed_;
};

}  // namespace prdp::kernels
