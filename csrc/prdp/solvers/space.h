#pragma once
#include <array>
#include <concepts>
#include <cstdint>
#include <utility>

// Functions that a kernel of a GPU holds once, and loops that it does not unroll: copied, they take a minute to compile
// there.
#ifndef PRDP_NOINLINE
#define PRDP_NOINLINE
#define PRDP_NO_UNROLL
#endif

/// What methods are written against. A space has vectors and one number per sample for each of its samples:
/// one sample on the CPU (sample_space.h) or a GPU (gpu/device/block_space.h), or a batch of plain tensors
/// (tensor_space.h). The iterate, the residual and the directions of samples that the loop around the method has frozen
/// keep their values; results such as that of apply() may be overwritten. A new method needs only the operations that
/// it calls. A new space needs all groups; what SpaceDefaults offers it may leave out.
namespace prdp {

/// A few numbers or handles of vectors that a method keeps beside its vectors, as array<X>() of the space gives them.
template <class Space, class X>
using ArrayOf = decltype(std::declval<const Space&>().template array<X>(int64_t{}));

/// What a method asks of array(), summed over its members: entries in arrays of vectors, entries in arrays of numbers,
/// and how many arrays. A kernel of a GPU has memory for exactly this.
struct ArraySizes {
  int64_t vectors = 0, numbers = 0, arrays = 0;
};
constexpr ArraySizes no_arrays(int64_t) { return {}; }

/// Where column j of a Hessenberg matrix begins, which has j + 2 numbers. The columns lie one behind the other: on a
/// GPU, each thread has a copy.
constexpr int64_t hessenberg_column(int64_t j) { return j * (j + 3) / 2; }

/// Ten operations that all methods are made of, and where their vectors come from.
template <class S>
concept Primitives =
    requires(S s, typename S::Vector x, typename S::Vector y, typename S::Vector p, typename S::Vector q,
             typename S::Vector r, typename S::Scalar alpha, typename S::Scalar beta) {
      /// A vector of zeros, which the method keeps.
      { s.vector() } -> std::convertible_to<typename S::Vector>;
      /// The right-hand side, scaled to the order of one; with a start, the residual of the start.
      { s.b() } -> std::convertible_to<typename S::Vector>;
      /// ‖b()‖² as it is now; the norm of the original right-hand side is SampleState::b2.
      { s.b2() } -> std::convertible_to<typename S::Scalar>;
      /// Entries of a vector; the unit roundoff. It is ε in skeel_estimate2() and in the loop around the methods, and
      /// ε/2 in guarded_quotient(), breaks_down() and damp().
      { s.unknowns() } -> std::same_as<int64_t>;
      { s.unit_roundoff() } -> std::same_as<double>;

      /// x = 0, of frozen samples too.
      s.fill_zero(x);
      /// y = x
      s.copy(x, y);
      /// x takes the value of y, and y that of x.
      s.advance(x, y);
      /// y += x
      s.add(x, y);
      /// y = x + beta y
      s.xpby(x, beta, y);
      /// x·y
      { s.dot(x, y) } -> std::same_as<typename S::Scalar>;
      /// x += alpha p and r -= alpha q; returns ‖r‖². p may be r.
      { s.update_iterate_and_residual(alpha, p, q, x, r) } -> std::same_as<typename S::Scalar>;
      /// y = A x
      s.apply(x, y);
      /// r = b - A x; with a start, the right-hand side - A (start + x). Projected on the range of A. Returns ‖r‖².
      { s.residual(x, r) } -> std::same_as<typename S::Scalar>;
      /// y = M⁻¹ x, which returns x·y; and whether there is a preconditioner M.
      { s.precondition(x, y) } -> std::same_as<typename S::Scalar>;
      { s.is_preconditioned() } -> std::same_as<bool>;
    };

/// What can be made of them, and faster in one pass (SpaceDefaults).
template <class S>
concept FusedOperations =
    requires(S s, typename S::Vector x, typename S::Vector y, typename S::Vector p, typename S::Scalar beta) {
      /// y = x + beta y; returns ‖y‖².
      { s.xpby_with_square(x, beta, y) } -> std::same_as<typename S::Scalar>;
      /// y = A x; returns x·y and ‖y‖².
      { s.apply_with_dots(x, y) } -> std::same_as<std::array<typename S::Scalar, 2>>;
      /// y = A x; returns p·y and ‖y‖², both for the guarded_quotient() that makes the next step.
      { s.apply_along(x, p, y) } -> std::same_as<std::array<typename S::Scalar, 2>>;
      /// Projects x onto range(A) if a null space was named.
      s.keep_in_range(x);
      /// y = M⁻¹ x ≈ A⁻¹ x, without the powers of two that TensorSpace puts into apply() and precondition(): a method
      /// that calls this calls neither.
      s.apply_cycle(x, y);
    };

/// Numbers, one per sample: quotients that tell a breakdown from nothing left to do, and choices per sample, as 1 or 0.
template <class S>
concept NumberOperations =
    requires(S s, typename S::Vector x, typename S::Vector y, typename S::Scalar a, typename S::Scalar b,
             typename S::Scalar num, typename S::Scalar den, typename S::Scalar v2, typename S::Scalar w2,
             typename S::Scalar active, typename S::Scalar where, double factor) {
      /// b = a
      s.assign(a, b);
      /// num/den for a step, where den = v·w, and v2 = ‖v‖² and w2 = ‖w‖². 0 where num is negligible or negative; NaN
      /// where w2 is not finite; 0 and a breakdown of the sample where den is rounding, |den| <= ε ‖v‖ ‖w‖.
      { s.guarded_quotient(num, den, v2, w2) } -> std::same_as<typename S::Scalar>;
      /// 1 where den is rounding, |den| <= ε ‖v‖ ‖w‖, both norms are finite and `active` is not zero; else 0.
      { s.breaks_down(den, v2, w2, active) } -> std::same_as<typename S::Scalar>;
      /// num/den for den >= 0; 0 where den is negligible.
      { s.ratio(num, den) } -> std::same_as<typename S::Scalar>;
      /// A breakdown of the samples where a is not positive, and v2 not negligible.
      s.break_down_unless_positive(a, v2);
      /// v2 + a² w2, which is ‖v + a w‖² for orthogonal v and w, for guarded_quotient() alone.
      { s.sum_of_squares(v2, a, w2) } -> std::same_as<typename S::Scalar>;
      /// 1 where |a|, a = v·w, is smaller than factor ‖v‖ ‖w‖, else 0; for restore() alone.
      { s.is_rounding(a, v2, w2, factor) } -> std::same_as<typename S::Scalar>;
      /// a where b and `active` are not zero, else 0.
      { s.unless_zero(a, b, active) } -> std::same_as<typename S::Scalar>;
      /// 1 where a is not zero, else 0.
      { s.is_not_zero(a) } -> std::same_as<typename S::Scalar>;
      /// 1 where a is zero, else 0.
      { s.is_zero(a) } -> std::same_as<typename S::Scalar>;
      /// 1 where a > b, else 0.
      { s.is_larger(a, b) } -> std::same_as<typename S::Scalar>;
      /// y = x, and b = a, where `where` is not zero.
      s.restore(where, x, y);
      s.restore(where, a, b);
    };

/// What every method needs.
template <class S>
concept VectorSpace = Primitives<S> && FusedOperations<S> && NumberOperations<S>;

/// What Jacobi's and Chebyshev's sweeps need beside.
template <class S>
concept SweepingSpace = VectorSpace<S> && requires(S s, typename S::Vector c, typename S::Vector x,
                                                   typename S::Vector y, int64_t n, const typename S::Scalar* omega) {
  /// y = D⁻¹ x
  s.divide_by_diagonal(x, y);
  /// n sweeps x ← c + x - D⁻¹A x, for which y is memory. With Chebyshev's weights omega y holds the iterate before x,
  /// on entry and on return.
  s.sweeps(c, x, y, n, omega);
  /// One sweep from x to y, which holds the iterate before x if there is an omega; returns ‖b - A x‖².
  { s.measured_sweep(c, x, y, omega) } -> std::same_as<typename S::Scalar>;
  /// The square of the spectral radius of I - D⁻¹A.
  { s.radius2() } -> std::same_as<typename S::Scalar>;
  /// Whether the norms of Jacobi's residuals are known to be a convex sequence on a logarithmic scale.
  { s.sweeps_are_log_convex() } -> std::same_as<bool>;
};

/// What GMRES and MINRES need beside: a basis, and numbers that may vanish.
template <class S>
concept KrylovSpace =
    VectorSpace<S> &&
    requires(S s, typename S::Vector x, ArrayOf<S, typename S::Vector> v, int64_t n, int64_t m, typename S::Scalar a,
             typename S::Scalar b, typename S::Scalar left2, typename S::Scalar taken2, typename S::Scalar loss,
             typename S::Scalar scale, typename S::Scalar keep, const typename S::Scalar* R,
             const typename S::Scalar* g, typename S::Scalar* h) {
      /// h_i = v_i·(a x) for the first n of v. They are constants, as is all that is called so here: on a tape and in
      /// autograd they have no derivative.
      s.dots(v, n, a, x, h);
      /// x = a x - Σ h_i v_i with a constant a; returns ‖x‖² as a constant.
      { s.subtract_combination(h, v, n, a, x) } -> std::same_as<typename S::Scalar>;
      /// x += Σ h_i v_i
      s.add_combination(h, v, n, x);
      /// Whether to make a vector orthogonal once more, by the squared norms of what is left of it and of what was
      /// taken off along the basis; `loss` accumulates the digits lost.
      { s.lost_orthogonality(left2, taken2, loss) } -> std::same_as<bool>;
      /// 1/a; 0 where a is rounding beside `scale`.
      { s.inverse(a, scale) } -> std::same_as<typename S::Scalar>;
      /// max(a, b)
      { s.larger(a, b) } -> std::same_as<typename S::Scalar>;
      /// Where `keep` is zero: h = argmin ‖g - R h‖² + (ε scale)² ‖h‖², for the upper triangle in the first n columns
      /// of R (hessenberg_column). A constant.
      s.damp(R, g, n, scale, keep, h);
      /// Whether a differs from zero in every sample; a space that would have to look closely may say no.
      { s.surely_all(a) } -> std::same_as<bool>;
      /// Whether the cycle of every sample has `ended`, is not zero; a space that would have to look closely may say
      /// no. Where it has, no products are counted up to residual().
      { s.all_ended(a) } -> std::same_as<bool>;
      /// a itself; its derivative is that of a constant.
      { s.constant(a) } -> std::same_as<typename S::Scalar>;
      /// A squared residual at which a cycle need not go on (SampleState::enough2).
      { s.enough2() } -> std::same_as<typename S::Scalar>;
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
  /// Estimates Skeel's ‖|A⁻¹| |A| |u|‖²; times ε² it is the square of the error of u that rounding of A causes.
  { s.skeel_estimate2(x) } -> std::same_as<typename S::Scalar>;
  /// Of each sample: whether A is positive definite for sure, and so are its factors, which have lost neither the shift
  /// nor the sides that hold u: Σ (row sum) x agrees with Σ b for x = A⁻¹ b.
  s.definite_factors(x);
};

/// All that methods need.
template <class S>
concept IterationSpace = SweepingSpace<S> && KrylovSpace<S> && FactorisedSpace<S>;

/// What the loop around the methods needs beside (iterate.h).
template <class S>
concept LoopSpace =
    Primitives<S> && requires(S s, typename S::Vector x, typename S::Vector kept, typename S::Scalar a, int64_t n,
                              typename S::States states, bool (*wanted)(const typename S::States::value_type&)) {
      // One number per sample, on the host:
      s.values_of(a);
      s.broken();           // whether it broke down
      s.operator_norm();    // ‖A‖
      s.surely_definite();  // whether A is known to be positive definite, and rounding does not change that
      /// ‖u‖², where u is x and the start.
      { s.solution2(x) } -> std::same_as<typename S::Scalar>;
      /// Estimates ‖|A| |u|‖² from below as ‖A S u‖², where S is a diagonal of ±1: those of is_negated_in() for attempt
      /// n.
      { s.componentwise_scale2(x, n) } -> std::same_as<typename S::Scalar>;
      /// A vector that the next operation may overwrite.
      { s.scratch() } -> std::convertible_to<typename S::Vector>;
      /// From here on, the samples that are not wanted are frozen.
      s.freeze_unless(states, wanted);
      /// wanted(state) of each sample, as values_of() are.
      s.map(states, wanted);
      /// x of the samples that are wanted, `kept` of the others.
      { s.select(s.map(states, wanted), kept, x) } -> std::convertible_to<typename S::Vector>;
      /// Forgets breakdowns and frozen samples, before the iterations run again.
      s.reset();
    };

/// The fused operations, one after the other. A space derives from it, and defines anew what it does in one pass.
template <class Space>
class SpaceDefaults {
 public:
  auto xpby_with_square(const auto& x, const auto& beta, auto&& y) {
    self().xpby(x, beta, y);
    return self().dot(y, y);
  }
  auto apply_with_dots(const auto& x, auto&& y) {
    self().apply(x, y);
    return std::array{self().dot(x, y), self().dot(y, y)};
  }
  auto apply_along(const auto& x, const auto& p, auto&& y) {
    auto found = self().apply_with_dots(x, y);
    if (!(x == p)) found[0] = self().dot(p, y);
    return found;
  }
  void keep_in_range(auto&&) {}
  void apply_cycle(const auto& x, auto&& y) { self().precondition(x, y); }

 private:
  Space& self() { return static_cast<Space&>(*this); }
};

}  // namespace prdp
