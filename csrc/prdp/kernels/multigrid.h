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
  enum Vector { kB, kX, kY, kR, kPartWay };
  /// A level with the vectors that this thread needs there.
  struct Level {
    const Kernel<T>*a, *transpose;
    std::unique_ptr<Kernel<T>> own, own_transpose;  // of coarse levels
    PaddedGrid grid;
    std::vector<PaddedGrid> part_way;  // grids behind each transfer but the last
    std::vector<T> p, q;               // coefficients of the smoothing steps
    Workspace<T> memory;               // b, x, y, r, and a vector for each of `part_way`

    /// What the t-th transfer restricts: r on the grid of the level, or what the one before it has made.
    const PaddedGrid& grid_before(size_t t) const { return t == 0 ? grid : part_way[t - 1]; }
    T* vector_before(size_t t) {
      return t == 0 ? memory.vector(kR) : memory.vector(kPartWay + static_cast<int64_t>(t) - 1);
    }
  };

  Multigrid(std::shared_ptr<const Hierarchy<T>> hierarchy, const Kernel<T>& a, const Kernel<T>* transpose,
            bool given_transposed, int64_t smoothing);
  void add_level(size_t l, const Kernel<T>& a, const Kernel<T>* transpose, int64_t smoothing);
  const Kernel<T>& kernel(const Level& level, bool transposed) const {
    return transposed && level.transpose ? *level.transpose : *level.a;
  }
  /// Whether the cycle is that of Aᵀ of what the hierarchy was made of.
  bool is_of_transpose(bool transposed) const { return transposed != given_transposed_; }
  /// Solves for b, roughly; returns the vector that holds the result.
  const T* cycle(size_t l, const T* b, bool transposed);
  /// Takes r of the level to the next one; returns b there.
  const T* restrict_residual(size_t l, bool transposed);
  /// Takes the `correction` from the next level, and adds it to x.
  void add_correction(size_t l, const T* correction, T* x, bool transposed);
  const T* solve_coarsest(const T* b, bool transposed);

  std::shared_ptr<const Hierarchy<T>> hierarchy_;
  bool given_transposed_;  // the kernel is Aᵀ of what the hierarchy was made of
  std::vector<Level> levels_;
  WholeVectors<T> vectors_;
  std::vector<T> contiguous_, solved_;
};

}  // namespace prdp::kernels
