#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <limits>
#include <utility>
#include <vector>

#include "prdp/kernels/direct_factors.h"
#include "prdp/solvers/iterate.h"
#include "prdp/solvers/solver.h"
#include "prdp/threads/interruption.h"

namespace prdp {

/// One sample after the other as a space for iterate(): vectors are padded memory of the thread's
/// workspace, and every operation is a plain loop in place. `Kernel` is one of kernels/.
template <class Kernel>
class SampleSpace {
 public:
  using T = typename Kernel::Scalar;
  using Factors = typename kernels::FactorsOf<Kernel>::Type;
  using Vector = T*;
  using Scalar = T;
  using States = std::array<SampleState, 1>;

  /// Vectors that the space itself keeps; two more where samples may have a start.
  static constexpr int64_t vectors(bool starts) { return starts ? 4 : 2; }

  SampleSpace(const Kernel& kernel, kernels::Workspace<T>& workspace, bool starts = false)
      : kernel_(&kernel), workspace_(workspace), own_(vectors(starts)), used_(own_) {}

  /// The operator of the samples that follow, with its direct method where that is wanted.
  void set_operator(const Kernel& kernel, const Factors* factors) {
    kernel_ = &kernel;
    factors_ = factors;
  }
  /// Takes over a sample, whose b the caller has put into b().
  void begin(SampleState& state) {
    state_ = &state;
    broken_ = started_ = false;
    b2_ = dot(b(), b());
  }
  void project([[maybe_unused]] Vector v) {
    if constexpr (kernels::kHasNullSpace<Kernel>) kernel_->project(v);
  }
  /// Starts the sample from α x0, where α = ⟨b, A x0⟩ / ⟨A x0, A x0⟩ makes the residual least, unless that is no better
  /// than zero. From here on b() is the residual of the start, and what the method looks for is added to it.
  void start_from(const T* x0) {
    const T magnitude = kernels::largest_magnitude(x0, unknowns());
    if (magnitude == T(0)) return;
    Vector x = start(), product = scratch(), r = whole_b();
    kernel_->load(x0, kernels::power_of_two_scale(magnitude), x);
    project(x);
    apply(x, product);
    project(product);
    const T largest = loops_.largest_magnitude(product, length());
    if (std::isfinite(largest) && largest > T(0)) {
      const T scale = kernels::power_of_two_scale(largest);
      loops_.scale(scale, product, product, length());
      const T alpha = dot(b(), product) / dot(product, product);
      std::copy(b(), b() + length(), r);
      loops_.axpy(-alpha, product, r, length());
      loops_.scale(scale, x, x, length());
      loops_.scale(alpha, x, x, length());
      const T left2 = dot(r, r);
      started_ = left2 < b2_ && std::isfinite(loops_.largest_magnitude(x, length()));
      if (started_) {
        std::swap_ranges(b(), b() + length(), r);
        b2_ = left2;
      }
    }
    fill_zero(product);
  }
  void add_start(Vector x) {
    if (started_) add(start(), x);
  }
  bool started() const { return started_; }
  /// What the start is; null without one.
  const T* started_from() { return started_ ? start() : nullptr; }

  Vector vector() {
    TORCH_INTERNAL_ASSERT(used_ < workspace_.count(), "the table of methods promises too few vectors");
    return workspace_.vector(used_++);
  }
  Vector scratch() { return workspace_.vector(1); }
  Vector b() { return workspace_.vector(0); }
  Scalar b2() const { return b2_; }
  int64_t unknowns() const { return kernel_->unknowns(); }
  double epsilon() const { return std::numeric_limits<T>::epsilon() / 2; }

  void fill_zero(Vector v) { std::fill(v, v + length(), T(0)); }
  void copy(const T* from, Vector to) { std::copy(from, from + length(), to); }
  void assign(Scalar from, Scalar& to) { to = from; }
  void advance(Vector& x, Vector& next) { std::swap(x, next); }
  void add(const T* d, Vector x) { loops_.axpy(T(1), d, x, length()); }
  void xpby(const T* x, Scalar beta, Vector y) { loops_.xpby(x, beta, y, length()); }
  Scalar dot(const T* a, const T* b) const { return loops_.dot(a, b, length()); }
  Scalar descend(Scalar alpha, const T* p, const T* q, Vector x, Vector r) {
    return loops_.descend(alpha, p, q, x, r, length());
  }

  /// out = A v; returns v·out and ‖out‖².
  std::array<Scalar, 2> apply_with_dots(const T* v, Vector out) {
    count(1);
    if constexpr (requires { kernel_->apply(v, out)[0]; }) return kernel_->apply(v, out);
    if constexpr (requires { kernel_->apply_with_dots(v, out); }) return kernel_->apply_with_dots(v, out);
    kernel_->apply(v, out);
    return {dot(v, out), dot(out, out)};
  }
  void apply(const T* v, Vector out) {
    count(1);
    kernel_->apply(v, out);
  }
  /// out = A M⁻¹ v. M is the diagonal, if anything: for others solve() takes plain tensors.
  void apply(const T* v, Vector out, Preconditioner preconditioner) {
    if (preconditioner == Preconditioner::kNone) return apply(v, out);
    kernel_->divide_by_diagonal(v, scratch());
    apply(scratch(), out);
  }
  void divide_by_diagonal(const T* b, Vector c) { kernel_->divide_by_diagonal(b, c); }
  /// w = |D|⁻¹, times the power of two that brings its largest entry into [1, 2).
  void inverse_diagonal(Vector w) {
    std::fill_n(scratch(), kernel_->unknowns(), T(1));
    kernel_->load(scratch(), T(1), w);
    fill_zero(scratch());
    kernel_->divide_by_diagonal(w, w);
    std::transform(w, w + length(), w, [](T d) { return std::abs(d); });
    loops_.scale(kernels::power_of_two_scale(loops_.largest_magnitude(w, length())), w, w, length());
  }
  /// The same with weights w: z = w∘v, entry by entry; Σ w_i v_i²; x += α p and r -= α q, with ‖r‖² and its
  /// weighted one; p = w∘r + β p.
  void weigh(const T* w, const T* v, Vector z) {
    fill_zero(z);
    loops_.weighted_xpby(w, v, T(0), z, length());
  }
  Scalar weighted_square(const T* w, const T* v) const { return loops_.weighted_square(w, v, length()); }
  std::array<Scalar, 2> descend(Scalar alpha, const T* p, const T* q, const T* w, Vector x, Vector r) {
    Scalar weighted;
    const Scalar plain = loops_.weighted_descend(alpha, p, q, w, x, r, length(), &weighted);
    return {plain, weighted};
  }
  void xpby(const T* w, const T* r, Scalar beta, Vector p) { loops_.weighted_xpby(w, r, beta, p, length()); }
  /// n Jacobi sweeps of x, overwriting next; and one from x to next, which returns ‖b - A x‖². With
  /// omega, Chebyshev's, where next holds the iterate before x, before and (the n) after.
  void sweeps(const T* c, Vector& x, Vector& next, int64_t n, const T* omega) {
    for (int64_t part; n > 0; n -= part) {
      part = std::min(n, interruption::Watch::at_once(work()));
      count(part);
      if constexpr (kernels::kHasSpectrum<Kernel>) kernel_->jacobi_sweeps(c, x, next, part, omega);
      else kernel_->jacobi_sweeps(c, x, next, part);
      if (omega) omega += part;
    }
  }
  Scalar measured_sweep(const T* c, const T* x, Vector next, const T* omega) {
    count(1);
    if constexpr (kernels::kHasSpectrum<Kernel>) return kernel_->jacobi_sweep(c, x, next, omega);
    else return kernel_->jacobi_sweep(c, x, next);
  }
  /// The square of the spectral radius of I - D⁻¹A; solve() sees to it that there is one.
  Scalar radius2() const {
    if constexpr (kernels::kHasSpectrum<Kernel>) return static_cast<T>(kernel_->radius() * kernel_->radius());
    else return 0;
  }
  /// Whether the norms of Jacobi's residuals are a convex sequence on a logarithmic scale.
  static constexpr bool sweeps_contract() { return kernels::kHasSpectrum<Kernel>; }
  /// r = b - A u, within the range of A, where u is x and the start; returns ‖r‖².
  Scalar residual(const T* x, Vector r) {
    apply(solution(x), r);
    const T* const of = started_ ? whole_b() : b();
    const T one = 1;
    const Scalar rr = loops_.multi_axpy(T(1), &one, &of, 1, T(-1), r, length());
    if constexpr (!kernels::kHasNullSpace<Kernel>) return rr;
    project(r);
    return dot(r, r);
  }
  /// ‖u‖²
  Scalar solution2(const T* x) {
    const T* u = solution(x);
    return dot(u, u);
  }
  void solve_directly(const T* r, Vector d) {
    if (factors_->solve(r, d)) return;
    broken_ = true;
    fill_zero(d);
  }

  /// num/den for a search step, where a2 and b2 are the squared norms of the two factors of den:
  /// 0 where nothing is left to do, and 0 with a breakdown where den is 0 relative to them.
  Scalar step_length(Scalar num, Scalar den, Scalar a2, Scalar b2) {
    if (num < kNegligible) return 0;
    if (!std::isfinite(b2)) return std::numeric_limits<T>::quiet_NaN();
    if (std::abs(den) <= std::numeric_limits<T>::epsilon() * std::sqrt(a2) * std::sqrt(b2)) {
      broken_ = true;
      return 0;
    }
    return num / den;
  }
  /// The same where b2 = Σ w_i q_i². Of that, 2‖q‖² is a bound, which mostly says enough.
  Scalar step_length(Scalar num, Scalar den, Scalar a2, const T* w, const T* q, Scalar plain2) {
    const T bound2 = 2 * plain2;
    const bool clear = std::abs(den) > std::numeric_limits<T>::epsilon() * std::sqrt(a2) * std::sqrt(bound2);
    return step_length(num, den, a2, clear && std::isfinite(bound2) ? bound2 : weighted_square(w, q));
  }
  Scalar ratio(Scalar num, Scalar den) const { return den < kNegligible ? T(0) : num / den; }

  /// What GMRES needs: linear combinations of several vectors, and numbers that may vanish.
  static constexpr int derivatives() { return 0; }
  Scalar constant(Scalar value) const { return value; }
  void dots(const std::vector<Vector>& v, int64_t count, Scalar factor, const T* w, Scalar* h) {
    loops_.multi_dot(v.data(), count, factor, w, h, length());
  }
  Scalar subtract_combination(const Scalar* h, const std::vector<Vector>& v, int64_t count, Scalar factor, Vector w) {
    return loops_.multi_axpy(T(-1), h, v.data(), count, factor, w, length());
  }
  void add_combination(const std::vector<Scalar>& y, const std::vector<Vector>& v, int64_t count, Vector x,
                       Preconditioner preconditioner) {
    const bool plain = preconditioner == Preconditioner::kNone;
    if (!plain) fill_zero(scratch());
    loops_.multi_axpy(T(1), y.data(), v.data(), count, T(1), plain ? x : scratch(), length());
    if (plain) return;
    kernel_->divide_by_diagonal(scratch(), scratch());
    add(scratch(), x);
  }
  /// Whether w, of which `left2` is left beside the `taken2` that went along the basis, needs another
  /// pass: each takes a share of the digits away, and three may be missing.
  bool lost_orthogonality(Scalar left2, Scalar taken2, Scalar& loss) const {
    const Scalar grown = (loss + 1) * std::sqrt((left2 + taken2) / left2);
    if (!(grown < 1000)) return true;
    loss = grown;
    return false;
  }
  /// 1/value; 0 where value is rounding beside `scale`.
  Scalar inverse(Scalar value, Scalar scale) const {
    return value <= kVanishing * std::abs(scale) || value < kNegligible ? T(0) : 1 / value;
  }
  Scalar larger(Scalar a, Scalar b) const { return a > b ? a : b; }
  Scalar is_larger(Scalar a, Scalar b) const { return a > b; }
  void restore(Scalar where, const T* from, Vector to) {
    if (where != 0) copy(from, to);
  }
  void restore(Scalar where, Scalar from, Scalar& to) const { to = where != 0 ? from : to; }
  Scalar is_zero(Scalar value) const { return value == 0; }
  Scalar is_not_zero(Scalar value) const { return value != 0; }
  bool surely_all(Scalar value) const { return value != 0; }

  std::array<double, 1> lanes(Scalar value) const { return {static_cast<double>(value)}; }
  std::array<bool, 1> broken() const { return {broken_}; }
  std::array<double, 1> operator_norm() const { return {kernel_->norm()}; }
  template <class Predicate>
  void freeze_unless(const States&, const Predicate&) {}  // a lone sample stops by leaving the loop
  template <class Function>
  auto map(const States& states, const Function& f) const {
    return std::array{f(states[0])};
  }
  Vector select(const std::array<bool, 1>&, Vector, Vector remade) const { return remade; }
  void run_again() {
    broken_ = false;
    workspace_.clear(1);
    clear(own_);
  }
  /// Zeroes the vectors from number `first` on, with their padding.
  void clear(int64_t first = 0) {
    for (int64_t i = first; i < workspace_.count(); ++i) workspace_.clear(i);
  }

 private:
  /// Squared norms below this are zero to the dtype, b being scaled to the order of one.
  static constexpr T kNegligible = std::numeric_limits<T>::min() / std::numeric_limits<T>::epsilon();

  static constexpr T kVanishing = 16 * std::numeric_limits<T>::epsilon();

  int64_t length() const { return kernel_->length(); }
  Vector start() { return workspace_.vector(2); }
  Vector whole_b() { return workspace_.vector(3); }
  const T* solution(const T* x) {
    if (!started_) return x;
    std::transform(x, x + length(), start(), scratch(), std::plus<T>());
    return scratch();
  }
  /// Of a product with A.
  int64_t work() const {
    if constexpr (requires { kernel_->stored(); }) return kernel_->stored() + kernel_->unknowns();
    else return kernel_->unknowns();
  }
  void count(int64_t products) {
    watch_.spend(products * work());
    state_->applications += products;
  }

  interruption::Watch& watch_ = interruption::Watch::local();
  const kernels::Loops<T>& loops_ = kernels::loops<T>();
  const Kernel* kernel_;
  const Factors* factors_ = nullptr;
  kernels::Workspace<T>& workspace_;
  SampleState* state_ = nullptr;
  int64_t own_, used_;
  T b2_ = 0;
  bool broken_ = false;
  bool started_ = false;  // from start(), and then whole_b() is what b() was
};

}  // namespace prdp
