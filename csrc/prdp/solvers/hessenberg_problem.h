#pragma once
#include <cstdint>

#include "prdp/solvers/space.h"

namespace prdp {

inline constexpr int64_t kNumbersOfColumn = 6;  // of HessenbergProblem::Column
constexpr ArraySizes arrays_of_hessenberg_problem(int64_t m) {
  return {.numbers = hessenberg_column(m) + kNumbersOfColumn * (m + 1) + 2 * m, .arrays = 4};
}

/// The small problem of a cycle of GMRES: y = argmin ‖‖r‖ e₁ - H y‖ for the Hessenberg matrix H of A v_j = Σ h_ij v_i,
/// which Givens rotations turn into a triangle R as its columns come. `Numbers` has what space.h asks of numbers that
/// may vanish.
template <class Numbers>
class HessenbergProblem {
 public:
  using Scalar = typename Numbers::Scalar;

  /// For at most m columns.
  HessenbergProblem(const Numbers& numbers, int64_t m)
      : numbers_(numbers),
        h_(numbers.template array<Scalar>(hessenberg_column(m))),
        columns_(numbers.template array<Column>(m + 1)),
        rhs_(numbers.template array<Scalar>(m)),
        damped_(numbers.template array<Scalar>(m)) {}

  /// Before the first cycle, where ‖r‖² is given; returns 1. The first cycle ends once its least residual² is below
  /// `enough2`. Later ones are whole, as their estimates may be rounding.
  Scalar start(const Scalar& residual2, const Scalar& enough2) {
    exhausted_ = numbers_.is_zero(residual2);
    scale_ = residual2 * 0;
    enough2_ = enough2;
    cycles_ = 0;
    return numbers_.is_zero(scale_);
  }
  /// The next cycle is not the first.
  void leave_first() { cycles_ = 1; }
  /// Begins a cycle with v₀ = r/‖r‖.
  void begin(const Scalar& length) {
    columns_[0].g = length;
    ++cycles_;
    solved2_ = length * length * kSolved2;
    columns_[0].inverse_length = numbers_.inverse(length, length);
    exhausted_ = numbers_.is_zero(length);
  }
  /// Where h_0j … h_{j+1,j} go.
  Scalar* column(int64_t j) { return &h(0, j); }
  /// Takes column j, once it is filled; `length` is ‖A v_j‖.
  PRDP_NOINLINE void add_column(int64_t j, const Scalar& length) {
    scale_ = numbers_.larger(scale_, length);
    // At sixteen units the space counts as exhausted, and goes on; at one, it ends.
    Scalar vanished = vanishes(h(j + 1, j), scale_);
    if (cycles_ == 1) vanished = vanished * numbers_.is_not_zero(columns_[j].inverse_length);  // it may have ended
    exhausted_ = exhausted_ + vanished;
    h(j + 1, j) = h(j + 1, j) * is_above(h(j + 1, j), scale_ * kOneUnit);
    const Scalar next = h(j + 1, j);
    rotate(j);
    const Scalar g = columns_[j + 1].g;  // ±the least residual so far
    columns_[j + 1].inverse_length = numbers_.inverse(next, rounding(g));
    if (cycles_ > 1) return;
    const Scalar goes_on = numbers_.is_zero(numbers_.is_larger(enough2_, g * g));
    columns_[j + 1].inverse_length = columns_[j + 1].inverse_length * goes_on;
  }
  /// Where y takes a step so long that its rounding exceeds ‖r‖ = size, A is singular to the dtype, and y is damped.
  PRDP_NOINLINE void minimise(int64_t columns, const Scalar& size, const Scalar& one) {
    Scalar short_enough = one;
    PRDP_NO_UNROLL for (int64_t j = columns - 1; j >= 0; --j) {
      Column& c = columns_[j];
      c.y = c.g;
      PRDP_NO_UNROLL for (int64_t k = j + 1; k < columns; ++k) c.y = c.y - h(j, k) * columns_[k].y;
      c.y = c.y * c.inverse_diagonal;
      short_enough = short_enough * is_above(size, scale_ * c.y);
    }
    if (!numbers_.surely_all(short_enough)) damp(columns, short_enough);
  }
  /// z ← (RᵀR)⁻¹ z
  void solve_normal(Scalar* z, int64_t columns) {
    PRDP_NO_UNROLL for (int64_t j = 0; j < columns; ++j) {
      PRDP_NO_UNROLL for (int64_t i = 0; i < j; ++i) z[j] = z[j] - h(i, j) * z[i];
      z[j] = z[j] * columns_[j].inverse_diagonal;
    }
    PRDP_NO_UNROLL for (int64_t j = columns - 1; j >= 0; --j) {
      PRDP_NO_UNROLL for (int64_t k = j + 1; k < columns; ++k) z[j] = z[j] - h(j, k) * z[k];
      z[j] = z[j] * columns_[j].inverse_diagonal;
    }
  }

  Scalar& y(int64_t j) { return columns_[j].y; }
  /// 1 over the length of what v_j was before it was scaled; 0 where that was rounding, or the cycle has ended.
  const Scalar& inverse_length(int64_t j) const { return columns_[j].inverse_length; }
  /// Not zero where the Krylov space could hardly be extended: it holds all that A reaches, but for rounding.
  const Scalar& exhausted() const { return exhausted_; }
  /// Not zero where column j is the last.
  Scalar ended(int64_t j) const { return numbers_.is_zero(columns_[j + 1].inverse_length); }
  /// The largest ‖A v‖ so far: what is rounding beside it is zero.
  Scalar& scale() { return scale_; }

 private:
  /// What belongs to number j of the basis. Numbers that are computed alike lie apart: compilers would combine
  /// neighbours in a vector load, which has to wait for the stores of each.
  struct Column {
    Scalar cos{};
    Scalar inverse_length{};
    Scalar sin{};
    Scalar inverse_diagonal{};  // 1/R_jj, or zero
    Scalar g{}, y{};
  };
  static_assert(sizeof(Column) == kNumbersOfColumn * sizeof(Scalar));
  static constexpr double kOneUnit = 1.0 / 16;  // numbers vanish at sixteen units of rounding
  static constexpr double kSolved2 = 1e-6;      // a cycle that takes a thousandth off its residual solves

  Scalar& h(int64_t i, int64_t j) { return h_[hessenberg_column(j) + i]; }

  /// Whether a is rounding beside s, as 1 or 0; and whether it is not.
  Scalar vanishes(const Scalar& a, const Scalar& s) const { return numbers_.is_zero(numbers_.inverse(a, s)); }
  Scalar is_above(const Scalar& a, const Scalar& s) const { return numbers_.is_not_zero(numbers_.inverse(a, s)); }
  /// Below this scale a number counts as zero. Sixteen units of rounding, the noise of a singular A or an exhausted
  /// space. But one unit while the residual g is large: a nearly singular A shows in numbers that small, and minimise()
  /// damps a y that gets too long.
  Scalar rounding(const Scalar& g) const {
    return scale_ - numbers_.is_larger(g * g, solved2_) * scale_ * (1 - kOneUnit);
  }
  /// Turns column j of h into one of R, and g along with it.
  void rotate(int64_t j) {
    using std::sqrt;
    PRDP_NO_UNROLL for (int64_t i = 0; i < j; ++i) {
      const Column& c = columns_[i];
      const Scalar upper = c.cos * h(i, j) + c.sin * h(i + 1, j);
      h(i + 1, j) = c.cos * h(i + 1, j) - c.sin * h(i, j);
      h(i, j) = upper;
    }
    Column& c = columns_[j];
    const Scalar diagonal = sqrt(h(j, j) * h(j, j) + h(j + 1, j) * h(j + 1, j));
    c.inverse_diagonal = numbers_.inverse(diagonal, rounding(c.g));  // 0 where A is singular on the space
    c.cos = h(j, j) * c.inverse_diagonal;
    c.sin = h(j + 1, j) * c.inverse_diagonal;
    h(j, j) = diagonal;
    columns_[j + 1].g = -(c.sin * c.g);
    c.g = c.cos * c.g;
  }
  /// y = argmin ‖g - R y‖² + τ² ‖y‖² where it is not short enough, τ being a few rounding errors of A: the next cycles
  /// recover what that holds back of a regular A, and along the null space of a singular one y stays short.
  void damp(int64_t columns, const Scalar& short_enough) {
    PRDP_NO_UNROLL for (int64_t j = 0; j < columns; ++j) {
      rhs_[j] = columns_[j].g;
      damped_[j] = columns_[j].y;
    }
    numbers_.damp(h_.data(), rhs_.data(), columns, scale_ * 4, short_enough, damped_.data());
    PRDP_NO_UNROLL for (int64_t j = 0; j < columns; ++j) {
      columns_[j].y = damped_[j];
      columns_[j].inverse_diagonal = columns_[j].inverse_diagonal * short_enough;
    }
  }

  const Numbers& numbers_;
  ArrayOf<Numbers, Scalar> h_;  // R once rotated
  ArrayOf<Numbers, Column> columns_;
  ArrayOf<Numbers, Scalar> rhs_, damped_;  // of damp()
  Scalar exhausted_{}, scale_{};
  Scalar solved2_{};  // ‖r‖² of a cycle that solves
  Scalar enough2_{};
  int64_t cycles_ = 0;  // begun
};

}  // namespace prdp
