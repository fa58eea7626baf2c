#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <tuple>

#include "prdp/solvers/hessenberg_problem.h"
#include "prdp/solvers/space.h"

namespace prdp {

constexpr ArraySizes arrays_of_gmres(int64_t m) {
  const auto problem = arrays_of_hessenberg_problem(m);
  return {m + 1, problem.numbers + 2 * (m + 1), problem.arrays + 3};  // u_; problem_, again_ and weights_
}

/// GMRES(m), restarted (Saad and Schultz 1986), for any operator. An iteration is a cycle: m products,
/// then the least residual over their Krylov space, so that the residual never grows. Gram–Schmidt
/// runs over all vectors at once, a second time where the first lost orthogonality; Givens rotations.
/// The basis v_j = u_j/‖u_j‖ is kept as the u_j, of which u_0 is the residual, and their inverse lengths:
/// no pass over memory is spent on scaling, and the next product need not wait for the length.
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
  GmresMethod(Space& space, int64_t restart)
      : x(space.vector()),
        space_(space),
        m_(std::min(restart, space.unknowns())),
        r_(space.vector()),
        kept_x_(space.vector()),
        kept_r_(space.vector()),
        z_(space.is_preconditioned() ? space.vector() : r_),
        sum_(space.is_preconditioned() ? space.vector() : r_),
        u_(space.template array<Vector>(m_ + 1)),
        products_(space.template array<Vector>(space.derivatives() > 0 ? m_ : 0)),
        problem_(space, m_),
        again_(space.template array<Scalar>(m_ + 1)),
        weights_(space.template array<Scalar>(m_ + 1)) {
    for (int64_t j = 1; j <= m_; ++j) u_[j] = space.vector();
  }

  PRDP_NOINLINE void start() {
    space_.fill_zero(x);
    space_.copy(space_.b(), r_);
    residual2_ = space_.b2();
    one_ = problem_.start(residual2_, space_.enough2());
    ready_ = true;
    confirmed_ = !space_.started();
  }
  PRDP_NOINLINE void step() {
    residual2();
    space_.copy(x, kept_x_);
    space_.advance(r_, kept_r_);
    u_[0] = kept_r_;
    const int64_t columns = extend_basis();
    minimise(columns);
    move_along_basis(columns);
    ready_ = false;
    confirmed_ = true;
  }
  /// ‖b - A x‖². A cycle that made it grow was rounding errors and is taken back.
  PRDP_NOINLINE auto residual2() {
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
  PRDP_NOINLINE auto recompute_residual() {
    if (confirmed_) return residual2();
    confirmed_ = true;
    return residual2_ = space_.residual(x, r_);
  }
  /// Not zero where the last cycle's Krylov space could not be extended: it holds all that A reaches.
  const Scalar& exhausted() const { return problem_.exhausted(); }

  /// What the next cycle starts from once residual2() is known; resume() once it has been put back.
  auto iteration_state() { return std::tie(x, problem_.scale()); }
  void resume(int64_t done) {
    if (done == 0) return start();
    problem_.leave_first();
    residual2_ = space_.b2() / 0;  // no cycle before to take back
    ready_ = false;
  }

  Vector x;

 protected:
  /// v₀ = r/‖r‖ and A v_j = Σ h_ij v_i, the h rotated into R as they come. Returns how many columns there are.
  PRDP_NOINLINE int64_t extend_basis() {
    using std::sqrt;
    problem_.begin(space_.constant(sqrt(residual2_)));
    loss_ = Scalar{};
    for (int64_t j = 0; j < m_; ++j) {
      if (space_.is_preconditioned()) space_.precondition(u_[j], z_);
      space_.apply(space_.is_preconditioned() ? z_ : u_[j], u_[j + 1]);
      if (space_.derivatives() > 0) products_[j] = u_[j + 1];
      problem_.add_column(j, orthogonalise(j));
      if (space_.all_ended(problem_.ended(j))) return j + 1;
    }
    return m_;
  }

  /// u_{j+1} = A v_j - Σ h_ij v_i, where A u_j was; fills column j of h. Returns the length of A v_j.
  PRDP_NOINLINE Scalar orthogonalise(int64_t j) {
    using std::sqrt;
    Scalar* column = problem_.column(j);
    auto [left2, taken2] = take_off_basis(problem_.inverse_length(j), j, column);
    const Scalar length = sqrt(taken2 + left2);
    if (space_.lost_orthogonality(left2, taken2, loss_)) {
      left2 = take_off_basis(one_, j, again_.data())[0];
      PRDP_NO_UNROLL for (int64_t i = 0; i <= j; ++i) column[i] = column[i] + again_[i];
    }
    column[j + 1] = sqrt(left2);
    return length;
  }

  /// w = factor u_{j+1}; along_i = v_i·w and u_{j+1} ← w - Σ along_i v_i, for i ≤ j. Returns the squares of u_{j+1}
  /// and of what was taken off.
  PRDP_NOINLINE std::array<Scalar, 2> take_off_basis(const Scalar& factor, int64_t j, Scalar* along) {
    space_.dots(u_, j + 1, factor, u_[j + 1], along);
    Scalar taken2{};
    PRDP_NO_UNROLL for (int64_t i = 0; i <= j; ++i) {
      along[i] = along[i] * problem_.inverse_length(i);
      weights_[i] = along[i] * problem_.inverse_length(i);
      taken2 = i == 0 ? along[i] * along[i] : taken2 + along[i] * along[i];
    }
    return {space_.subtract_combination(weights_.data(), u_, j + 1, factor, u_[j + 1]), taken2};
  }
  /// x += M⁻¹ Σ weights_j u_j
  PRDP_NOINLINE void move_along_basis(int64_t columns) {
    if (!space_.is_preconditioned()) return space_.add_combination(weights_.data(), u_, columns, x);
    space_.fill_zero(sum_);
    space_.add_combination(weights_.data(), u_, columns, sum_);
    space_.precondition(sum_, z_);
    space_.add(z_, x);
  }
  /// The weights of the u_j that belong to y.
  void weigh(int64_t columns) {
    PRDP_NO_UNROLL for (int64_t j = 0; j < columns; ++j) weights_[j] = problem_.y(j) * problem_.inverse_length(j);
  }

  /// y = argmin ‖r - A V y‖; its derivative is that of a constant where it is damped.
  PRDP_NOINLINE void minimise(int64_t columns) {
    using std::sqrt;
    problem_.minimise(columns, space_.constant(sqrt(residual2_)), one_);
    for (int derivative = 1; derivative <= space_.derivatives(); ++derivative) {
      Vector e = kept_r_;
      weigh(columns);
      space_.subtract_combination(weights_.data(), products_, columns, one_, e);
      auto change = space_.template array<Scalar>(columns);
      for (int64_t j = 0; j < columns; ++j) change[j] = space_.dot(products_[j], e) * problem_.inverse_length(j);
      problem_.solve_normal(change.data(), columns);
      for (int64_t j = 0; j < columns; ++j) problem_.y(j) = problem_.y(j) + change[j];
    }
    weigh(columns);
  }

  Space& space_;
  int64_t m_;
  Vector r_, kept_x_, kept_r_, z_, sum_;
  ArrayOf<Space, Vector> u_, products_;  // orthogonal basis; A u_j, kept while recording
  HessenbergProblem<Space> problem_;
  ArrayOf<Space, Scalar> again_, weights_;  // of a second pass; of the u_j
  Scalar residual2_{}, grew_{};
  Scalar loss_{};  // of orthogonality, in units of rounding
  Scalar one_{};
  bool ready_ = false;     // r_ and residual2_ belong to x
  bool confirmed_ = true;  // and were computed from it: those of a start were not
};

}  // namespace prdp
