#pragma once
#include <array>
#include <memory>
#include <optional>
#include <variant>
#include <vector>

#include "prdp/kernels/axis_products.h"
#include "prdp/kernels/factor_cache.h"
#include "prdp/kernels/fourier_multiplier.h"
#include "prdp/kernels/packed_stencil.h"

namespace prdp::kernels {

/// A stencil as a sum of operators along the axes, A = A_z ⊗ I ⊗ I + I ⊗ A_y ⊗ I + I ⊗ I ⊗ A_x, with symmetric A_d.
/// Constant coefficients are such a sum, whatever the boundaries, and so are coefficients that vary along one axis
/// only.
using SumOverAxes = std::array<Eigen::MatrixXd, 3>;
/// Nothing if the stencil is none, up to rounding.
template <class T>
std::optional<SumOverAxes> as_sum_over_axes(const PackedStencil<T>& a);

/// Whether such a sum is looked for on a grid of these extents (z, y, x): shorter axes have no three points, and the
/// eigenvectors of longer ones take longer than sparse factors.
bool has_axes_to_diagonalise(int64_t dim, const int64_t* shape);
/// How far coefficients may be from those of a sum, beside ‖A‖∞: what rounding hides.
inline double slack_of_sum(double norm, double epsilon) { return 16.0 * epsilon * norm; }
bool is_symmetric(const Eigen::MatrixXd& a, double slack);
/// Rows whose diagonals differ by more are not of one size: what is rounding beside the largest may be all that another
/// one holds.
inline constexpr double kWidestRows = 1e3;

struct DiagonalisedSum {
  /// Of the A_d, as columns; none where these are circulant: then they are waves, and `inverse` is in the order of the
  /// wavenumbers.
  std::optional<SumOverAxes> eigenvectors;
  /// The inverses of all eigenvalues of A, x last, zero for the null vectors; nothing if A has more of these.
  std::optional<std::vector<double>> inverse;
};
/// `epsilon`: the rounding that the A_d carry. `null_vectors`: how many vectors A maps to zero, as somebody named them.
DiagonalisedSum diagonalise(const SumOverAxes& a, double epsilon, int64_t null_vectors);

/// The exact solver of such a sum, in the eigenvectors of the A_d (Lynch, Rice and Thomas 1964). With constant
/// coefficients on a periodic grid these are waves.
template <class T>
class FastDiagonalisation {
 public:
  FastDiagonalisation(const SumOverAxes& a, int64_t null_vectors);

  bool is_regular() const { return !std::holds_alternative<std::monostate>(made_); }
  /// field ← A⁻¹ field, or the pseudo-inverse where null vectors were named. Any thread may call this.
  void solve(std::vector<T>& field) const;
  int64_t bytes() const;

 private:
  struct Products {
    AxisProducts<T> eigenvectors;
    std::vector<T> inverse;  // of the eigenvalues
  };
  std::variant<std::monostate, Products, FourierMultiplier<T>> made_;  // nothing of a singular sum
};

/// That of a stencil, from the cache or made; null if the stencil is no such sum.
template <class T>
std::shared_ptr<const FastDiagonalisation<T>> fast_diagonalisation(const PackedStencil<T>& a, const FactorKey& key,
                                                                   int64_t null_vectors);

}  // namespace prdp::kernels
