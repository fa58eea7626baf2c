#pragma once
#include <array>
#include <memory>
#include <optional>
#include <vector>

#include "prdp/kernels/axis_products.h"
#include "prdp/kernels/factor_cache.h"
#include "prdp/kernels/stencil_rows.h"

namespace prdp::kernels {

/// A stencil as a sum of operators along the axes, A = A_z ⊗ I ⊗ I + I ⊗ A_y ⊗ I + I ⊗ I ⊗ A_x, with symmetric A_d.
/// Constant coefficients are such a sum, whatever the boundaries, and so are coefficients that vary along one axis
/// only.
using SumOverAxes = std::array<Eigen::MatrixXd, 3>;
/// Nothing if the stencil is none, up to rounding.
template <class T>
std::optional<SumOverAxes> as_sum_over_axes(const StencilRows<T>& a);

/// The eigenvectors of the A_d, as columns, and their eigenvalues.
struct Diagonalised {
  SumOverAxes eigenvectors;
  std::array<Eigen::VectorXd, 3> eigenvalues;
};

/// The exact solver of such a sum, in the eigenvectors of the A_d (Lynch, Rice and Thomas 1964).
template <class T>
class FastDiagonalisation {
 public:
  /// `null_vectors`: how many vectors A maps to zero, as somebody named them.
  FastDiagonalisation(const SumOverAxes& a, int64_t null_vectors);

  bool is_regular() const { return is_regular_; }
  /// field ← A⁻¹ field, or the pseudo-inverse where null vectors were named. Any thread may call this.
  void solve(std::vector<T>& field) const;
  int64_t bytes() const;

 private:
  FastDiagonalisation(const Diagonalised& found, int64_t null_vectors);

  AxisProducts<T> eigenvectors_;
  std::vector<T> inverse_;  // of the eigenvalues
  bool is_regular_ = true;
};

/// That of a stencil, from the cache or made; null if the stencil is no such sum.
template <class T>
std::shared_ptr<const FastDiagonalisation<T>> fast_diagonalisation(const StencilRows<T>& a, const FactorKey& key,
                                                                   int64_t null_vectors);

}  // namespace prdp::kernels
