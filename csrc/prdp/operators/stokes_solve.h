#pragma once
#include "prdp/grid/grid.h"

namespace prdp {

/// The Navier-Stokes step without its winds, [[C, 0, G₁], [0, C, G₂], [D₁, D₂, 0]] with C = I/Δt - ν L:
/// solved exactly, wave number by wave number, with FFTs. Nearly A itself where the winds are weak
/// beside dx/Δt, hence a preconditioner.
class StokesSolve {
 public:
  /// A periodic grid in two dimensions.
  StokesSolve(const Grid& grid, const at::Tensor& nu, double dt, at::ScalarType dtype);

  /// The solution of mean pressure 0 for v (batch, 3, Ny, Nx), or that of the transposed system.
  /// Differentiable in v and nu.
  at::Tensor operator()(const at::Tensor& v, bool transposed) const;

 private:
  at::Tensor gradient_, divergence_;  // (2, Ny, Nx/2 + 1), complex: symbols of G and D
  at::Tensor momentum_;               // (Ny, Nx/2 + 1): symbol of C
  at::Tensor inverse_laplacian_;      // 1/|G|², 0 for the mean
};

}  // namespace prdp
