#pragma once
#include <algorithm>
#include <cmath>
#include <tuple>
#include <vector>

#include "prdp/solvers/space.h"

namespace prdp {

/// GMRES(m), restarted (Saad and Schultz 1986), for any operator. An iteration is a cycle: m products,
/// then the least residual over their Krylov space, so that the residual never grows. Gram–Schmidt
/// runs over all vectors at once, a second time where the first lost orthogonality; Givens rotations.
///
/// Where autograd records the cycle, the coefficients h of the basis are constants: the least residual
/// belongs to the space, whatever its basis. The minimiser's own dependence enters by Newton steps that
/// change nothing in value; two of them give two derivatives.
template <KrylovSpace Space>
class GmresMethod {
 public:
  using Scalar = typename Space::Scalar;
  using Vector = typename Space::Vector;

  /// Preconditioned from the right, A M⁻¹ y = b with x = M⁻¹ y: the residual is that of A u = b.
  GmresMethod(Space& space, int64_t restart, Preconditioner preconditioner)
      : x(space.vector()),
        space_(space),
        preconditioner_(preconditioner),
        m_(std::min(restart, space.unknowns())),
        r_(space.vector()),
        kept_x_(space.vector()),
        kept_r_(space.vector()),
        h_(m_ * (m_ + 1)),
        inverse_(m_),
        cos_(m_),
        sin_(m_),
        g_(m_ + 1),
        y_(m_),
        again_(m_ + 1) {
    for (int64_t j = 0; j <= m_; ++j) v_.push_back(space.vector());
    if (space.derivatives() > 0) products_.resize(m_);
  }

  void start() {
    space_.fill_zero(x);
    space_.copy(space_.b(), r_);
    residual2_ = space_.b2();
    exhausted_ = space_.is_zero(residual2_);
    scale_ = residual2_ * 0;
    ready_ = true;
    confirmed_ = !space_.started();
  }
  void step() {
    residual2();
    space_.copy(x, kept_x_);
    space_.copy(r_, kept_r_);
    columns_ = extend_basis();
    minimise(columns_);
    space_.add_combination(y_, v_, columns_, x, preconditioner_);
    ready_ = false;
    confirmed_ = true;
  }
  /// ‖b - A x‖². A cycle that made it grow was rounding errors and is taken back.
  auto residual2() {
    if (ready_) return residual2_;
    Scalar fresh = space_.residual(x, r_);
    grew_ = space_.is_larger(fresh, residual2_);
    space_.restore(grew_, kept_x_, x);
    space_.restore(grew_, kept_r_, r_);
    space_.restore(grew_, residual2_, fresh);
    residual2_ = fresh;
    ready_ = true;
    return residual2_;
  }
  auto recompute_residual() {
    if (confirmed_) return residual2();
    confirmed_ = true;
    return residual2_ = space_.residual(x, r_);
  }
  /// Not zero where the last cycle's Krylov space could not be extended: it holds all that A reaches.
  const Scalar& exhausted() const { return exhausted_; }

  /// What the next cycle starts from once residual2() is known; resume() once it has been put back.
  auto carried() { return std::tie(x, scale_); }
  void resume(int64_t done) {
    if (done == 0) return start();
    residual2_ = space_.b2() / 0;  // no cycle before to take back
    ready_ = false;
  }

  Vector x;

 protected:
  Scalar& h(int64_t i, int64_t j) { return h_[j * (m_ + 1) + i]; }

  /// v₀ = r/‖r‖ and A v_j = Σ h_ij v_i, rotated into R as they come. Returns how many columns there are.
  int64_t extend_basis() {
    using std::sqrt;
    g_[0] = space_.constant(sqrt(residual2_));
    space_.scale(r_, space_.inverse(g_[0], g_[0]), v_[0]);
    exhausted_ = space_.is_zero(g_[0]);
    loss_ = Scalar{};
    for (int64_t j = 0; j < m_; ++j) {
      space_.apply(v_[j], v_[j + 1], preconditioner_);
      if (space_.derivatives() > 0) products_[j] = v_[j + 1];
      scale_ = space_.larger(scale_, orthogonalise(j));
      const Scalar inverse = space_.inverse(h(j + 1, j), scale_);
      h(j + 1, j) = h(j + 1, j) * space_.is_not_zero(inverse);
      exhausted_ = exhausted_ + space_.is_zero(inverse);
      space_.scale(v_[j + 1], inverse, v_[j + 1]);
      rotate(j);
      if (space_.all_exhausted(exhausted_)) return j + 1;
    }
    return m_;
  }

  /// w = v_{j+1} ← w - Σ h_ij v_i; fills column j of h. Returns the length that w had.
  Scalar orthogonalise(int64_t j) {
    using std::sqrt;
    Scalar* column = &h(0, j);
    space_.dots(v_, j + 1, v_[j + 1], column);
    Scalar left2 = space_.subtract_combination(column, v_, j + 1, v_[j + 1]);
    Scalar taken2 = column[0] * column[0];
    for (int64_t i = 1; i <= j; ++i) taken2 = taken2 + column[i] * column[i];
    const Scalar length = sqrt(taken2 + left2);
    if (space_.lost_orthogonality(left2, taken2, loss_)) {
      space_.dots(v_, j + 1, v_[j + 1], again_.data());
      left2 = space_.subtract_combination(again_.data(), v_, j + 1, v_[j + 1]);
      for (int64_t i = 0; i <= j; ++i) column[i] = column[i] + again_[i];
    }
    column[j + 1] = sqrt(left2);
    return length;
  }

  /// Turns column j of h into one of R, and g along with it.
  void rotate(int64_t j) {
    using std::sqrt;
    for (int64_t i = 0; i < j; ++i) {
      const Scalar upper = cos_[i] * h(i, j) + sin_[i] * h(i + 1, j);
      h(i + 1, j) = cos_[i] * h(i + 1, j) - sin_[i] * h(i, j);
      h(i, j) = upper;
    }
    const Scalar diagonal = sqrt(h(j, j) * h(j, j) + h(j + 1, j) * h(j + 1, j));
    inverse_[j] = space_.inverse(diagonal, scale_);  // 0 where A is singular on the space
    cos_[j] = h(j, j) * inverse_[j];
    sin_[j] = h(j + 1, j) * inverse_[j];
    h(j, j) = diagonal;
    g_[j + 1] = -(sin_[j] * g_[j]);
    g_[j] = cos_[j] * g_[j];
  }

  /// y = argmin ‖r - A V y‖. A column that would take so long a step that its rounding exceeds r is
  /// left out with all after it: A is singular there, to the dtype.
  void minimise(int64_t columns) {
    using std::sqrt;
    const Scalar size = space_.constant(sqrt(residual2_));
    for (int64_t j = columns - 1; j >= 0; --j) {
      y_[j] = g_[j];
      for (int64_t k = j + 1; k < columns; ++k) y_[j] = y_[j] - h(j, k) * y_[k];
      y_[j] = y_[j] * inverse_[j];
      const Scalar kept = space_.is_not_zero(space_.inverse(size, scale_ * y_[j]));
      for (int64_t k = j; k < columns; ++k) {
        y_[k] = y_[k] * kept;
        inverse_[k] = inverse_[k] * kept;
      }
    }
    for (int derivative = 1; derivative <= space_.derivatives(); ++derivative) {
      Vector e = r_;
      space_.subtract_combination(y_.data(), products_, columns, e);
      std::vector<Scalar> change(columns);
      for (int64_t j = 0; j < columns; ++j) change[j] = space_.dot(products_[j], e);
      solve_normal(change);
      for (int64_t j = 0; j < columns; ++j) y_[j] = y_[j] + change[j];
    }
  }

  /// z ← (RᵀR)⁻¹ z
  void solve_normal(std::vector<Scalar>& z) {
    const auto columns = static_cast<int64_t>(z.size());
    for (int64_t j = 0; j < columns; ++j) {
      for (int64_t i = 0; i < j; ++i) z[j] = z[j] - h(i, j) * z[i];
      z[j] = z[j] * inverse_[j];
    }
    for (int64_t j = columns - 1; j >= 0; --j) {
      for (int64_t k = j + 1; k < columns; ++k) z[j] = z[j] - h(j, k) * z[k];
      z[j] = z[j] * inverse_[j];
    }
  }

  Space& space_;
  Preconditioner preconditioner_;
  int64_t m_;
  Vector r_, kept_x_, kept_r_;
  std::vector<Vector> v_, products_;  // orthonormal basis; A v_j, kept while recording
  std::vector<Scalar> h_, inverse_;   // by columns, R once rotated; 1/R_jj
  std::vector<Scalar> cos_, sin_, g_, y_, again_;
  Scalar residual2_{}, exhausted_{}, grew_{};
  Scalar loss_{};   // of orthogonality, in units of rounding
  Scalar scale_{};  // largest ‖A v‖ so far: what is rounding beside it is zero
  int64_t columns_ = 0;  // of the last cycle
  bool ready_ = false;   // r_ and residual2_ belong to x
  bool confirmed_ = true;  // and were computed from it: those of a start were not
};

}  // namespace prdp
