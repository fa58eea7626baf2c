#pragma once
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>

#include "prdp/gpu/device/block_vectors.h"
#include "prdp/gpu/device/saddle_point.h"
#include "prdp/kernels/scales.h"
#include "prdp/solvers/iterate.h"
#include "prdp/solvers/sample_numbers.h"
#include "prdp/solvers/solve_damped.h"

namespace prdp::gpu {

/// One sample as a space for iterate(), on a GPU: a team of threads owns it, and a number is the same in every thread.
template <class S>
class BlockSpace : public BlockVectors<S>, public SampleNumbers<typename S::T>, public SpaceDefaults<BlockSpace<S>> {
  using Vectors = BlockVectors<S>;
  using Numbers = SampleNumbers<typename S::T>;
  using Numbers::broken_;
  using Vectors::beyond_;
  using Vectors::each;
  using Vectors::into;
  using Vectors::largest_over_rows;
  using Vectors::own;
  using Vectors::team_;
  using Vectors::vector_at;

 public:
  using T = typename S::T;
  using A = typename S::A;
  using Vector = T*;
  using Scalar = T;
  using typename Vectors::TeamOfSample;
  using Vectors::add;
  using Vectors::copy;
  using Vectors::dot;
  using Vectors::scratch;
  using Vectors::xpby_with_square;

  /// `in_block`: memory of the block, for coarse grids and then the first vectors. `beyond`: of the device, for the
  /// other vectors, for damping, and for coarse grids that do not fit.
  BlockSpace(TeamOfSample& team, const A& a, const SolveArguments<T>& of, int64_t sample, T* in_block, T* beyond)
      : Vectors(team, in_block + S::Cycles::kInBlock, beyond),
        a_(a),
        cycle_{of.hierarchy, sample, in_block, beyond + Vectors::kCyclesAt},
        null_space_(of.null_space),
        left_null_space_(of.left_null_space),
        sample_(sample),
        needs_projection_(of.needs_projection != 0),
        constant_(T(1) / std::sqrt(static_cast<T>(of.left_null_space.length))) {}

  // ---- a sample (solve_sample.h)
  void begin(SampleState& state) {
    state_ = &state;
    broken_ = started_ = false;
  }
  void take_b() { b2_ = dot(b(), b()); }
  /// A as it will be used; false where it is not finite.
  PRDP_NOINLINE bool prepare_operator() {
    if (!scale_operator<T>(team_, a_)) return false;
    factor_ = a_.factor();
    norm_ = largest_over_rows([&](int i) { return a_.norm_of_row(i); });
    if constexpr (requires { A::kMayBeUnheld; })
      if (A::kMayBeUnheld && !is_singular())
        return largest_over_rows([&](int i) { return std::abs(a_.row_sum(i)); }) > 0;
    return true;
  }
  T factor() const { return factor_; }
  PRDP_NOINLINE bool has_zero_diagonal() {
    return largest_over_rows([&](int i) { return T(a_.diagonal(i) == T(0)); }) != 0;
  }
  /// project: orthogonal projection onto range(A), returns the norm of what it removes. project_solution: onto the
  /// complement of null(A).
  T project(Vector v) { return project(left_null_space_, v); }
  T project_solution(Vector v) { return project(null_space_, v); }
  bool is_singular() const { return left_null_space_.count > 0; }
  Vector start() { return own(Vectors::kStart); }
  Vector original_b() { return own(Vectors::kOriginalB); }
  /// From here on b() is what start() leaves of it, which is in original_b(); they change places.
  PRDP_NOINLINE void shift_to_start(T left2) {
    this->template each<1>([&](int i) { return Pair{b()[i], original_b()[i]}; },
                           [&](int i, Pair both) {
                             original_b()[i] = both.first;
                             b()[i] = both.second;
                           });
    started_ = true;
    b2_ = left2;
  }
  void add_start(Vector x) {
    if (started_) add(start(), x);
  }
  bool started() const { return started_; }
  Scalar enough2() const { return static_cast<T>(state_->enough2); }

  // ---- what space.h asks for
  Vector b() { return own(Vectors::kB); }
  Scalar b2() const { return b2_; }
  PRDP_NOINLINE Scalar update_iterate_and_residual(Scalar alpha, const T* p, const T* q, Vector x, Vector r) {
    T s[2] = {0, 0};
    const bool on_one = projects_on_one();
    each([&](int i) { return Pair{x[i] + alpha * p[i], r[i] - alpha * q[i]}; },
         [&](int i, Pair next) {
           x[i] = next.first;
           r[i] = next.second;
           s[0] += next.second * next.second;
           if (on_one) s[1] += entry_of(left_null_space_, 0, 0, i) * next.second;
         });
    sum_with_part(s);
    return needs_projection_ ? projected(r, s[0], s[1]) : s[0];  // no product takes away what rounding leaves there
  }
  PRDP_NOINLINE void apply(const T* v, Vector out) {
    product(v, [&](int i, T value) { out[i] = value; });
    if (needs_projection_) project(out);
  }
  void keep_in_range(Vector v) {
    if (needs_projection_) project(v);
  }
  PRDP_NOINLINE std::array<Scalar, 2> apply_with_dots(const T* v, Vector out) {
    T s[3] = {0, 0, 0};
    const bool on_one = projects_on_one();
    product(v, [&](int i, T value) {
      out[i] = value;
      s[0] += v[i] * value;
      s[1] += value * value;
      if (on_one) s[2] += entry_of(left_null_space_, 0, 0, i) * value;
    });
    sum_with_part(s);
    // v·out stays, as v has no part in the null space but rounding.
    return {s[0], needs_projection_ ? projected(out, s[1], s[2]) : s[1]};
  }
  /// r = b - A u, within the range of A, where u is x and the start; returns ‖r‖².
  PRDP_NOINLINE Scalar residual(const T* x, Vector r) {
    const T* const of = started_ ? original_b() : b();
    T s = 0;
    product<false>(solution(x), [&](int i, T value) {
      const T left = of[i] - value;
      r[i] = left;
      s += left * left;
    });
    const T rr = team_.sum(s);
    if (!is_singular()) return rr;
    project(r);
    return dot(r, r);
  }
  Scalar solution2(const T* x) {
    const T* u = solution(x);
    return dot(u, u);
  }
  PRDP_NOINLINE Scalar componentwise_scale2(const T* x, int64_t attempt) {
    const T* const u = solution(x);
    Vector signed_u = scratch();
    this->template each<1>([&](int i) { return is_negated_in(attempt, i) ? -u[i] : u[i]; }, into(signed_u));
    T s = 0;
    product<false>(signed_u, [&](int, T value) { s += value * value; });
    --state_->applications;  // no part of the method
    return team_.sum(s);
  }

  static constexpr bool is_preconditioned() { return S::kByDiagonal || S::Cycles::kAny; }
  PRDP_NOINLINE Scalar precondition(const T* v, Vector out) {
    T s = 0;
    if constexpr (S::Cycles::kAny) {
      if constexpr (std::is_same<A, typename A::Cycled>::value)
        cycle_.apply(team_, a_, v, out, vector_at(0), vector_at(1), vector_at(2));
      else
        SaddlePoint<S>{
            team_, a_, cycle_, {vector_at(0), vector_at(1), vector_at(2), vector_at(3), vector_at(4), vector_at(5)}}
            .apply(v, out);
      if (null_space_.count > 0) project_solution(out);  // cycles leave rounding there, which they would amplify
      return dot(v, out);
    }
    const A a = a_;  // as in product()
    each([&](int i) { return v[i] / a.diagonal(i); },
         [&](int i, T value) {
           out[i] = value;
           s += v[i] * value;
         });
    return team_.sum(s);
  }
  /// Whether there is a preconditioner of the kind that is asked for.
  bool has_preconditioner() const { return cycle_.exists(); }

  PRDP_NOINLINE void divide_by_diagonal(const T* x, Vector y) {
    const A a = a_;  // as in product()
    each([&](int i) { return x[i] / a.diagonal(i); }, into(y));
  }
  PRDP_NOINLINE void sweeps(const T* c, Vector& x, Vector& next, int64_t n, const T* omega) {
    for (int64_t k = 0; k < n; ++k, std::swap(x, next)) sweep(c, x, next, omega ? omega + k : nullptr, [](int, T) {});
  }
  PRDP_NOINLINE Scalar measured_sweep(const T* c, const T* x, Vector next, const T* omega) {
    T s = 0;
    sweep(c, x, next, omega, [&](int i, T change) {
      const T left = change * a_.diagonal(i);
      s += left * left;
    });
    return team_.sum(s);
  }
  Scalar radius2() const { return static_cast<T>(a_.radius() * a_.radius()); }
  static constexpr bool sweeps_are_log_convex() { return A::kKnowsRadius; }

  /// Seldom: one thread computes it.
  PRDP_NOINLINE void damp(const Scalar* r, const Scalar* g, int64_t n, Scalar scale, Scalar keep, Scalar* y) const {
    if (keep != 0) return;
    T* const work = beyond_ + Vectors::kDampingAt;
    T* const found = work + numbers_of_solve_damped(n);
    if (team_.leads()) solve_damped(r, g, n, std::numeric_limits<T>::epsilon() * scale, found, work);
    team_.meet();
    for (int64_t j = 0; j < n; ++j) y[j] = found[j];
  }
  using Numbers::restore;
  void restore(Scalar where, const T* from, Vector to) {
    if (where != 0) copy(from, to);
  }
  void solve_directly(const T*, Vector) {}  // no method on a GPU does
  Scalar skeel_estimate2(const T*) const { return 0; }
  std::array<bool, 1> definite_factors(const Vector&) const { return {false}; }

  // ---- what iterate.h asks for
  std::array<double, 1> operator_norm() const { return {norm_}; }
  std::array<bool, 1> surely_definite() {
    if constexpr (requires { a_.row_sum(0); })
      return {!is_singular() && largest_over_rows([&](int i) { return T(a_.row_sum(i) < T(0)); }) == 0 &&
              largest_over_rows([&](int i) { return a_.row_sum(i); }) > 0};
    else return {false};
  }
  void reset() { broken_ = false; }

 private:
  struct Pair {
    T first, second;
  };
  /// A row of the Navier-Stokes equations is long, and its text is there once.
  static constexpr bool kIsLong = requires { A::kVelocity; };
  /// Where a row has loads enough, those of others need not be under way with them.
  static constexpr int kRowsAtOnce = requires { A::kLoadsEnough; } ? 1 : kCellsAtOnce;
  /// store(i, (A v)_i) for this thread's cells. Slower threads still read v: between a product and the next write to v
  /// there must be a barrier, which a sum or another product has. Every method has one; a test leaves them out in turn.
  template <bool kOften = true, class Store>
  void product(const T* v, const Store& store) {
    ++state_->applications;
    team_.meet();
    if constexpr (kOften && !kIsLong) {
      const A a = a_;  // in registers; a member's members would be loaded again for each cell
      this->template each<kRowsAtOnce>([&](int i) { return a.product(v, i); }, store);
    } else {
      this->template each<1>([&](int i) { return entry_of_product(v, i); }, store);
    }
  }
  PRDP_NOINLINE T entry_of_product(const T* v, int i) const { return a_.product(v, i); }
  /// Jacobi: next = x + change, where change = c - D⁻¹A x. Chebyshev, with omega: next holds the iterate before x and
  /// becomes next + omega (x + change - next). Calls tell(i, change_i).
  template <class Tell>
  void sweep(const T* c, const T* x, Vector next, const T* omega, const Tell& tell) {
    const A a = a_;  // as in product()
    product(x, [&](int i, T value) {
      const T change = c[i] - value / a.diagonal(i);
      const T plain = x[i] + change;
      if constexpr (A::kKnowsRadius) next[i] = omega ? next[i] + *omega * (plain - next[i]) : plain;
      else next[i] = plain;
      tell(i, change);
    });
  }
  /// Entry i of basis vector k, in this of the fields that have one.
  T entry_of(const NullSpaceArguments<T>& space, int field, int k, int i) const {
    const int length = static_cast<int>(space.length), at = i - (static_cast<int>(space.first) + field) * length;
    if (at < 0 || at >= length) return T(0);
    return space.basis ? space.basis[sample_ * space.sample + k * length + at] : constant_;
  }
  /// Parts no larger than `negligible` stay.
  PRDP_NOINLINE T project(const NullSpaceArguments<T>& space, Vector v, T negligible = 0) {
    double part2 = 0;
    for (int field = 0; field < static_cast<int>(space.fields); ++field)
      for (int k = 0; k < static_cast<int>(space.count); ++k) {
        T s = 0;
        each([&](int i) { return entry_of(space, field, k, i) * v[i]; }, [&](int, T value) { s += value; });
        const T along = team_.sum(s);
        if (std::abs(along) <= negligible) continue;
        take_off(space, field, k, along, v);
        part2 += static_cast<double>(along) * static_cast<double>(along);
      }
    return static_cast<T>(std::sqrt(part2));
  }
  void take_off(const NullSpaceArguments<T>& space, int field, int k, T along, Vector v) {
    each([&](int i) { return v[i] - along * entry_of(space, field, k, i); }, into(v));
  }
  /// Whether products are projected, and on a single vector: the sum for that goes along with others.
  bool projects_on_one() const { return needs_projection_ && left_null_space_.count * left_null_space_.fields == 1; }
  /// Sums over the team. The last of s is the part along the single null vector; without one it is not summed.
  template <int n>
  void sum_with_part(T (&s)[n]) {
    if (projects_on_one()) return team_.sum(s);
    T others[n - 1];
    for (int k = 0; k < n - 1; ++k) others[k] = s[k];
    team_.sum(others);
    for (int k = 0; k < n - 1; ++k) s[k] = others[k];
  }
  /// Takes v's part in null(Aᵀ) off if it is above ε/8 ‖v‖; vv is ‖v‖², and the new one is returned. `along` is that
  /// part where projects_on_one(); else it is found here.
  PRDP_NOINLINE T projected(Vector v, T vv, T along) {
    const T negligible = std::numeric_limits<T>::epsilon() / 8 * std::sqrt(vv);
    if (!projects_on_one()) along = project(left_null_space_, v, negligible);
    else if (!(std::abs(along) <= negligible)) take_off(left_null_space_, 0, 0, along, v);
    else return vv;
    return along * along < vv / 2 ? vv - along * along : dot(v, v);  // a difference of near numbers has few digits
  }
  PRDP_NOINLINE const T* solution(const T* x) {
    if (!started_) return x;
    this->template each<1>([&](int i) { return x[i] + start()[i]; }, into(scratch()));
    return scratch();
  }

  A a_;
  typename S::Cycles::template Of<S> cycle_;
  SampleState* state_ = nullptr;
  const NullSpaceArguments<T>&null_space_, &left_null_space_;
  int64_t sample_;
  bool needs_projection_;
  T constant_;  // the entry of a vector of equal numbers whose norm is one
  T factor_ = 1, b2_ = 0;
  double norm_ = 0;
  bool started_ = false;
};

}  // namespace prdp::gpu
