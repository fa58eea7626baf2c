#pragma once
#include <optional>
#include <vector>

#include "prdp/kernels/hierarchy.h"
#include "prdp/kernels/preconditioner.h"

namespace prdp::kernels {

/// M⁻¹ r is one V-cycle from zero, with `smoothing` steps before and after each coarse grid: Chebyshev's on D⁻¹A over
/// [ρ/4, ρ]. No products of vectors with each other, so it is linear in r; M⁻ᵀ is the cycle of the transpose.
template <class T>
class Multigrid final : public Preconditioner<T> {
 public:
  /// Null if the operator has no grid, or its coarse grids no inverse diagonal. `transpose`, the kernel of Aᵀ, is
  /// needed for apply_transpose() where A is not symmetric.
  static std::unique_ptr<Multigrid> make(const Kernel<T>& a, const Kernel<T>* transpose, int64_t smoothing);

  T apply(const T* r, T* z) override;
  void apply_transpose(const T* r, T* z) override;

 private:
  /// A level with the vectors that this thread needs there.
  struct Level {
    const Kernel<T>*a, *transpose;
    std::unique_ptr<Kernel<T>> own, own_transpose;  // of coarse levels
    PaddedGrid grid;
    std::vector<PaddedGrid> part_way;  // grids behind each transfer but the last
    std::vector<T> p, q;               // coefficients of the smoothing steps
    Workspace<T> memory;               // b, x, y, r, and a vector for each of `part_way`
  };
  enum Vector { kB, kX, kY, kR, kPartWay };

  Multigrid(std::shared_ptr<const Hierarchy<T>> hierarchy, const Kernel<T>& a, const Kernel<T>* transpose,
            bool kernel_is_transposed, int64_t smoothing);
  void add_level(size_t l, const Kernel<T>& a, const Kernel<T>* transpose, int64_t smoothing);
  const Kernel<T>& kernel(const Level& level, bool transposed) const {
    return transposed && level.transpose ? *level.transpose : *level.a;
  }
  /// Solves for b, roughly; returns the vector that holds the result.
  const T* cycle(size_t l, const T* b, bool transposed);
  const T* solve_coarsest(const T* b, bool transposed);

  std::shared_ptr<const Hierarchy<T>> hierarchy_;
  bool kernel_is_transposed_;  // it is Aᵀ of what the hierarchy was made of
  std::vector<Level> levels_;
  WholeVectors<T> vectors_;
  std::vector<T> contiguous_, solved_;
};

}  // namespace prdp::kernels
