#pragma once
#include <array>
#include <concepts>
#include <cstdint>
#include <utility>

/// What methods are written against. A space has vectors and one number per sample for each of its samples:
/// one sample in padded memory (sample_space.h), or a batch of plain tensors (tensor_space.h). An operation
/// that writes to a vector leaves the samples alone that the loop around the method has frozen. A new space
/// needs all of these operations, a new method none but those that it calls.
namespace prdp {

/// A few numbers or handles of vectors that a method keeps beside its vectors, as array<X>() of the space gives them.
template <class Space, class X>
using ArrayOf = decltype(std::declval<const Space&>().template array<X>(int64_t{}));

/// What every method needs.
template <class S>
concept VectorSpace = requires(S s, typename S::Vector x, typename S::Vector y, typename S::Vector p,
                               typename S::Vector q, typename S::Scalar a, typename S::Scalar b) {
  /// A vector of zeros, which the method keeps.
  { s.vector() } -> std::convertible_to<typename S::Vector>;
  /// The right-hand side, scaled to the order of one; with a start, the residual of the start.
  { s.b() } -> std::convertible_to<typename S::Vector>;
  /// ‖b‖²
  { s.b2() } -> std::convertible_to<typename S::Scalar>;
  /// Entries of a vector.
  { s.unknowns() } -> std::same_as<int64_t>;
  /// x = 0, of frozen samples too.
  s.fill_zero(x);
  /// y = x
  s.copy(x, y);
  /// b = a
  s.assign(a, b);
  /// x takes the value of y, and y that of x.
  s.advance(x, y);
  /// y += x
  s.add(x, y);
  /// y = x + a y; and the same, returning ‖y‖².
  s.xpby(x, a, y);
  /// y = x - a y
  s.xmby(x, a, y);
  { s.xpby_with_square(x, a, y) } -> std::same_as<typename S::Scalar>;
  /// x·y
  { s.dot(x, y) } -> std::same_as<typename S::Scalar>;
  /// x += a p and y -= a q; returns ‖y‖². p may be y.
  { s.descend(a, p, q, x, y) } -> std::same_as<typename S::Scalar>;
  /// y = A x
  s.apply(x, y);
  /// y = A x; returns x·y and ‖y‖².
  { s.apply_with_dots(x, y) } -> std::same_as<std::array<typename S::Scalar, 2>>;
  /// y = A x; returns p·y and, for a step_length() whose step the next descend() takes, ‖y‖².
  { s.apply_along(x, p, y) } -> std::same_as<std::array<typename S::Scalar, 2>>;
  /// a + b² c, the square of the norm of r + b p for orthogonal r and p, for step_length() alone.
  { s.sum_of_squares(a, b, a) } -> std::same_as<typename S::Scalar>;
  /// Whether there is a preconditioner M; y = M⁻¹ x, which returns x·y.
  { s.is_preconditioned() } -> std::same_as<bool>;
  { s.precondition(x, y) } -> std::same_as<typename S::Scalar>;
  /// y = M⁻¹ x ≈ A⁻¹ x, of the A that residual() has: no scale of the two is left open.
  s.correct(x, y);
  /// y = b - A x, projected on the range of A; with a start, of x and the start. Returns ‖y‖².
  { s.residual(x, y) } -> std::same_as<typename S::Scalar>;
  /// a/b for a step, where the third and fourth are the squares of the norms whose product bounds b: 0 where a is
  /// negligible, and 0 with a breakdown where b is rounding beside that bound.
  { s.step_length(a, b, a, b) } -> std::same_as<typename S::Scalar>;
  /// 1 where step_length() would break down dividing by a, and the last is not zero, else 0; for restore() alone.
  { s.breaks_down(a, a, b, b) } -> std::same_as<typename S::Scalar>;
  /// a/b for b >= 0; 0 where b is negligible.
  { s.ratio(a, b) } -> std::same_as<typename S::Scalar>;
  /// A breakdown of the samples where a is not positive, and b not negligible.
  s.break_down_unless_positive(a, b);
  /// 1 where a is less than the number times the root of b c, else 0; for restore() alone.
  { s.is_rounding(a, b, a, 0.0) } -> std::same_as<typename S::Scalar>;
  /// a where b and the last are not zero, else 0.
  { s.unless_zero(a, b, b) } -> std::same_as<typename S::Scalar>;
  /// 1 where a is not zero, else 0; and the other way round.
  { s.is_not_zero(a) } -> std::same_as<typename S::Scalar>;
  { s.is_zero(a) } -> std::same_as<typename S::Scalar>;
  /// 1 where a > b, else 0.
  { s.is_larger(a, b) } -> std::same_as<typename S::Scalar>;
  /// y = x, and b = a, where the first is not zero.
  s.restore(a, x, y);
  s.restore(a, a, b);
  /// Unit roundoff.
  { s.epsilon() } -> std::same_as<double>;
};

/// What Jacobi's and Chebyshev's sweeps need beside.
template <class S>
concept SweepingSpace = VectorSpace<S> && requires(S s, typename S::Vector c, typename S::Vector x,
                                                   typename S::Vector y, int64_t n, const typename S::Scalar* omega) {
  /// y = D⁻¹ x
  s.divide_by_diagonal(x, y);
  /// n sweeps x ← c + x - D⁻¹A x, of which y keeps the last but one; Chebyshev's with their weights omega.
  s.sweeps(c, x, y, n, omega);
  /// One sweep from x to y; returns ‖b - A x‖².
  { s.measured_sweep(c, x, y, omega) } -> std::same_as<typename S::Scalar>;
  /// The square of the spectral radius of I - D⁻¹A.
  { s.radius2() } -> std::same_as<typename S::Scalar>;
  /// Whether the norms of Jacobi's residuals are known to be a convex sequence on a logarithmic scale.
  { s.sweeps_contract() } -> std::same_as<bool>;
};

/// What GMRES needs beside: a basis, and numbers that may vanish.
template <class S>
concept KrylovSpace =
    VectorSpace<S> && requires(S s, typename S::Vector x, typename S::Vector y, ArrayOf<S, typename S::Vector> v,
                               int64_t n, int64_t m, typename S::Scalar a, typename S::Scalar b,
                               const typename S::Scalar* w, const typename S::Scalar* g, typename S::Scalar* h) {
      /// h_i = v_i·(a x) for the first n of v, as constants.
      s.dots(v, n, a, x, h);
      /// x = a x - Σ h_i v_i with a constant a; returns ‖x‖² as a constant.
      { s.subtract_combination(h, v, n, a, x) } -> std::same_as<typename S::Scalar>;
      /// x += Σ h_i v_i
      s.add_combination(h, v, n, x);
      /// Whether a vector, of which a is left beside the b that went along the basis (both squared), is to be made
      /// orthogonal once more; the last keeps count of the digits lost.
      { s.lost_orthogonality(a, b, a) } -> std::same_as<bool>;
      /// 1/a; 0 where a is rounding beside b.
      { s.inverse(a, b) } -> std::same_as<typename S::Scalar>;
      /// max(a, b)
      { s.larger(a, b) } -> std::same_as<typename S::Scalar>;
      /// Where the last but one is zero: h = argmin ‖g - R h‖² + (ε b)² ‖h‖², for the upper triangle R in the first n
      /// columns of w, of which each has m entries. A constant.
      s.damp(w, m, g, n, b, a, h);
      /// Whether a differs from zero in every sample; a space that would have to look closely may say no.
      { s.surely_all(a) } -> std::same_as<bool>;
      /// a itself; its derivative is that of a constant.
      { s.constant(a) } -> std::same_as<typename S::Scalar>;
      /// How often the operations are recorded to be differentiated.
      { s.derivatives() } -> std::same_as<int>;
      /// Whether the samples have a start.
      { s.started() } -> std::same_as<bool>;
    };

/// What a direct method needs beside.
template <class S>
concept FactorisedSpace = VectorSpace<S> && requires(S s, typename S::Vector x, typename S::Vector y) {
  /// y = A⁻¹ x; zero with a breakdown where A is singular.
  s.solve_directly(x, y);
};

/// All of it, and what the loop around the methods needs (iterate.h).
template <class S>
concept IterationSpace = SweepingSpace<S> && KrylovSpace<S> && FactorisedSpace<S> &&
                         requires(S s, typename S::Vector x, typename S::Scalar a, typename S::States states,
                                  bool (*wanted)(const typename S::States::value_type&)) {
                           /// One number per sample, on the host.
                           s.lanes(a);
                           /// Which samples broke down; ‖A‖ of each; ‖u‖², where u is x and the start.
                           s.broken();
                           s.operator_norm();
                           { s.solution2(x) } -> std::same_as<typename S::Scalar>;
                           /// ‖A v‖² for u with its signs changed without a pattern: about ‖|A| |u|‖², as the terms of
                           /// a product do not cancel.
                           { s.terms2(x) } -> std::same_as<typename S::Scalar>;
                           /// From here on, operations write to the samples alone that are wanted.
                           s.freeze_unless(states, wanted);
                           /// Forgets breakdowns and frozen samples, before the iterations run again.
                           s.reset();
                         };

}  // namespace prdp
