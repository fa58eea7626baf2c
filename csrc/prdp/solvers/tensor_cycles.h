#pragma once
#include <memory>
#include <vector>

#include "prdp/operators/operator.h"
#include "prdp/solvers/tensor_stencil.h"

namespace prdp {

/// The V-cycle of kernels/multigrid.h in plain tensor operations, for devices without loops. Coarse operators are
/// probed: products with vectors that are one on every third point tell their stencils.
class TensorCycles {
 public:
  /// For `a` on a grid, or for Aᵀ, and vectors like b, with `smoothing` steps before and after each coarse grid.
  TensorCycles(const Operator& a, bool of_transpose, int64_t smoothing, const at::Tensor& b);

  /// M⁻¹ v, or M⁻ᵀ v, for v (batch, channel, *shape); differentiable in v.
  at::Tensor apply(const at::Tensor& v, bool transposed) const { return cycle(0, v, transposed); }

 private:
  /// One axis with every second point dropped. Weights are those of the points between, for the coarse point before
  /// and for the one after.
  struct Transfer {
    int64_t axis, fine, coarse;  // the axis from the end; points along it
    bool periodic;
    at::Tensor order;  // of the coarse points and those between, as they lie on the fine axis
    struct {
      at::Tensor before, after;
    } interpolation, restriction;
  };
  struct Level {
    TensorStencil a, transpose;
    at::Tensor inverse_diagonal;                    // (batch or 1, 1, *shape)
    std::vector<std::array<at::Tensor, 2>> steps;   // p and q of each smoothing step, (batch or 1, 1, …)
    std::vector<Transfer> transfers;                // to the next level; empty on the last
  };

  static Transfer make_transfer(const TensorStencil& a, const TensorStencil& transpose, int64_t axis);
  static at::Tensor interpolate(const Transfer& t, const at::Tensor& coarse, bool transposed);
  static at::Tensor restrict(const Transfer& t, const at::Tensor& fine, bool transposed);
  at::Tensor cycle(size_t l, const at::Tensor& b, bool transposed) const;

  std::vector<Level> levels_;
  at::Tensor coarsest_inverse_;  // (batch or 1, n, n)
};

}  // namespace prdp
