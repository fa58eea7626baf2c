#pragma once
#include <memory>
#include <vector>

#include "prdp/operators/operator.h"
#include "prdp/solvers/tensor_stencil.h"
#include "prdp/solvers/tensor_transfer.h"

namespace prdp {

/// The V-cycle of kernels/multigrid.h in plain tensor operations, for devices without loops. Products with vectors that
/// are one on every third point tell the stencil of A. The host looks at the device once to see its shape, and once for
/// each coarser grid, to choose the axes. Cycles are kept for later solves with the same A, as factorisations are
/// (kernels/factor_cache.h): one product and one look tell whether it is the same.
class TensorCycles {
 public:
  /// For `a` on a grid, or for Aᵀ, and vectors like b, with `smoothing` steps before and after each coarse grid.
  static std::shared_ptr<const TensorCycles> find_or_make(const Operator& a, bool of_transpose, int64_t smoothing,
                                                          const at::Tensor& b);
  TensorCycles(const Operator& a, bool of_transpose, int64_t smoothing, const at::Tensor& b);

  /// M⁻¹ v, or M⁻ᵀ v, for v (batch, channel, *shape); differentiable in v.
  at::Tensor apply(const at::Tensor& v, bool transposed) const { return cycle(0, v, transposed); }

  int64_t bytes() const;

 private:
  /// x ← x + p (x - x₋) + w (b - A x)
  struct Smoothing {
    double p;
    at::Tensor w;  // q D⁻¹, (batch or 1, 1, *shape)
  };
  struct Level {
    TensorStencil a, transpose;
    std::vector<Smoothing> steps;
    std::vector<TensorTransfer> transfers;  // to the next level; empty on the last
  };

  at::Tensor cycle(size_t l, const at::Tensor& b, bool transposed) const;

  std::vector<Level> levels_;
  at::Tensor coarsest_inverse_;  // (batch or 1, n, n)
};

}  // namespace prdp
