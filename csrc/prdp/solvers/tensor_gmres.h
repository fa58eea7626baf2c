#pragma once
#include <ATen/ATen.h>

#include <cstdint>
#include <vector>

#include "prdp/solvers/tensor_space.h"

namespace prdp {

/// GMRES(m) of a batch on another device: the cycles of GmresMethod, in a tenth of its operations. The basis is one
/// tensor, and a pass of Gram–Schmidt two batched products; there are always two. The host solves the small problem of
/// the cycle, in float64: it looks at the device once before the iterate moves, and once after.
class TensorGmres {
 public:
  TensorGmres(TensorSpace& space, int64_t restart);

  void start();
  void step();
  /// ‖b - A x‖². A cycle that made it grow was rounding errors and is taken back.
  at::Tensor residual2();
  at::Tensor recompute_residual();
  /// Not zero where the last cycle's Krylov space could not be extended: it holds all that A reaches.
  const at::Tensor& exhausted() const { return exhausted_; }

  at::Tensor x;

 private:
  /// v₀ = r/‖r‖ and A M⁻¹ v_j = Σ h_ij v_i
  void extend_basis();
  void orthogonalise(int64_t j, const at::Tensor& w);
  /// y = argmin ‖r - A M⁻¹ V y‖, (batch, m, 1); sets `exhausted`.
  at::Tensor minimise();
  /// Row j of the basis, as a vector of the space.
  at::Tensor vector(int64_t j) const { return v_.select(0, j).view(space_.b().sizes()); }
  /// Rows 0 to j of each sample, (batch, j + 1, unknowns).
  at::Tensor rows(int64_t j) const { return v_.narrow(0, 0, j + 1).permute({1, 0, 2}); }

  TensorSpace& space_;
  int64_t m_;
  at::Tensor r_, kept_x_, kept_r_, residual2_, exhausted_;
  at::Tensor v_, h_;           // (m, batch, unknowns) and (batch, m + 1, m), anew for each cycle
  std::vector<double> scale_;  // of each sample, the largest ‖A v‖ so far: what is rounding beside it is zero
  bool is_first_ = true;       // the next cycle
  bool ready_ = false;         // r_ and residual2_ belong to x
  bool confirmed_ = true;      // and were computed from it: those of a start were not
};

}  // namespace prdp
