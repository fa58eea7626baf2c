#pragma once
#include <memory>
#include <mutex>
#include <optional>
#include <vector>

#include "prdp/kernels/kernel.h"
#include "prdp/kernels/packed_stencil.h"
#include "prdp/kernels/transfer.h"

namespace prdp::kernels {

/// The coarse grids of an operator with their operators, Galerkin products (galerkin.h), and the way between them. It
/// serves the operator and its transpose, any number of channels, and several threads at once.
template <class T>
class Hierarchy {
 public:
  struct Level {
    StencilGrid grid;
    double radius;                       // at least that of D⁻¹A: the largest sum of a row
    std::vector<Transfer<T>> transfers;  // to the next level, one axis after the other; empty on the last
  };

  /// `nullity`: how many vectors A is said to map to zero. Null if a diagonal is zero on some grid, or a number left
  /// the range of T.
  static std::unique_ptr<const Hierarchy> make(StencilFields<T> finest, int64_t nullity);

  const std::vector<Level>& levels() const { return levels_; }
  /// A, or Aᵀ, on level `l` >= 1.
  std::shared_ptr<const PackedStencil<T>> packed(size_t l, bool transposed) const;
  /// (n, n): the inverse on the last level; of a singular matrix the pseudo-inverse.
  const std::vector<T>& coarsest_inverse() const { return coarsest_inverse_; }
  int64_t bytes() const;

 private:
  Hierarchy() = default;
  bool invert_coarsest(const StencilFields<T>& a, int64_t nullity);

  bool symmetric_ = true;
  std::vector<Level> levels_;
  std::vector<std::shared_ptr<const PackedStencil<T>>> packed_;  // of the levels from 1 on
  std::vector<StencilFields<T>> fields_;  // their fields, of which Aᵀ is packed; empty if A is symmetric
  mutable std::mutex mutex_;
  mutable std::vector<std::shared_ptr<const PackedStencil<T>>> transposed_;
  std::vector<T> coarsest_inverse_;
};

}  // namespace prdp::kernels
