#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "prdp/solvers/iterate.h"
#include "prdp/solvers/kept_signs.h"
#include "prdp/solvers/sample_numbers.h"
#include "prdp/solvers/sample_system.h"
#include "prdp/solvers/solve_damped.h"
#include "prdp/solvers/space.h"
#include "prdp/threads/interruption.h"

namespace prdp {

/// One sample after the other as a space for iterate(): vectors are padded memory of the thread's
/// workspace, and every operation is a plain loop in place.
template <class T>
class SampleSpace : public SampleNumbers<T>, public SpaceDefaults<SampleSpace<T>> {
  using SampleNumbers<T>::broken_;

 public:
  using Vector = T*;
  using Scalar = T;

  /// Vectors that the space itself keeps; two more where samples may have a start.
  static constexpr int64_t vectors(bool starts) { return starts ? 4 : 2; }

  /// The system may be set anew between samples; its layout stays.
  SampleSpace(const SampleSystem<T>& system, kernels::Workspace<T>& workspace, bool starts = false)
      : system_(system), workspace_(workspace), own_(vectors(starts)), used_(own_) {}

  // ---- a sample (solve_sample.h)
  void begin(SampleState& state) {
    state_ = &state;
    broken_ = started_ = false;
  }
  /// y = factor x, of memory of the caller, and the other way round, which returns max |u|.
  void load(const T* x, T factor, Vector y) { layout().load(x, factor, y); }
  T store(const T* x, T factor, T* u) {
    layout().store(x, factor, u);
    return largest_given(u);
  }
  T largest_given(const T* x) const { return kernels::largest_magnitude(x, unknowns()); }
  /// b() is complete.
  void take_b() { b2_ = dot(b(), b()); }
  T factor() const { return system_.a().factor(); }
  bool is_singular() const { return system_.a().null_space().has_value(); }
  /// project: orthogonal projection onto range(A), returns the norm of what it removes. project_solution: onto the
  /// complement of null(A).
  T project(Vector v) {
    const auto& space = system_.a().left_null_space();
    return space ? space->project(v) : T(0);
  }
  void project_solution(Vector v) {
    if (const auto& space = system_.a().null_space()) space->project(v);
  }
  T largest_magnitude(const T* x) const { return vectors_.largest_magnitude(x, length()); }
  void scale(T factor, Vector x) { vectors_.scale(factor, x, x, length()); }
  void axpy(T alpha, const T* x, Vector y) { vectors_.axpy(alpha, x, y, length()); }
  Vector start() { return workspace_.vector(2); }
  Vector original_b() { return workspace_.vector(3); }
  /// From here on b() is what start() leaves of it, which is in original_b(); they change places.
  void shift_to_start(T left2) {
    std::swap_ranges(b(), b() + length(), original_b());
    started_ = true;
    b2_ = left2;
  }
  void add_start(Vector x) {
    if (started_) add(start(), x);
  }
  bool started() const { return started_; }
  /// What the start is; null without one.
  const T* started_from() { return started_ ? start() : nullptr; }

  // ---- what space.h asks for
  Vector vector() {
    TORCH_INTERNAL_ASSERT(used_ < workspace_.count(), "the table of methods promises too few vectors");
    return workspace_.vector(used_++);
  }
  Vector scratch() { return workspace_.vector(1); }
  Vector b() { return workspace_.vector(0); }
  Scalar b2() const { return b2_; }
  int64_t unknowns() const { return system_.a().unknowns(); }
  template <class X>
  std::vector<X> array(int64_t n) const {
    return std::vector<X>(n);
  }

  void fill_zero(Vector v) { vectors_.fill_zero(v, length()); }
  void copy(const T* from, Vector to) { vectors_.copy(from, to, length()); }
  void advance(Vector& x, Vector& next) { std::swap(x, next); }
  void add(const T* d, Vector x) { vectors_.axpy(T(1), d, x, length()); }
  void xpby(const T* x, Scalar beta, Vector y) { vectors_.xpby(x, beta, y, length()); }
  Scalar xpby_with_square(const T* x, Scalar beta, Vector y) { return vectors_.xpby_with_square(x, beta, y, length()); }
  Scalar dot(const T* a, const T* b) const { return vectors_.dot(a, b, length()); }
  Scalar update_iterate_and_residual(Scalar alpha, const T* p, const T* q, Vector x, Vector r) {
    const Scalar rr = vectors_.update_iterate_and_residual(alpha, p, q, x, r, length());
    return system_.a().needs_projection() ? projected(r, rr) : rr;  // no product takes away what rounding leaves there
  }

  std::array<Scalar, 2> apply_with_dots(const T* v, Vector out) {
    count(1);
    auto dots = system_.a().apply_with_dots(v, out);
    // v·out stays, as v has no part in the null space but rounding.
    if (system_.a().needs_projection()) dots[1] = projected(out, dots[1]);
    return dots;
  }
  void apply(const T* v, Vector out) {
    count(1);
    system_.apply(v, out);
    if (system_.a().needs_projection()) project(out);
  }
  void keep_in_range(Vector v) {
    if (system_.a().needs_projection()) project(v);
  }
  bool projects_products() const { return system_.a().needs_projection(); }
  bool is_preconditioned() const { return system_.preconditioner(); }
  bool is_preconditioned_by_diagonal() const { return system_.by_diagonal(); }
  Scalar precondition(const T* v, Vector out) {
    const Scalar product = system_.preconditioner()->apply(v, out);
    if (system_.by_diagonal() || !system_.a().null_space()) return product;
    project_solution(out);  // cycles leave rounding there, which they would amplify
    return dot(v, out);
  }
  /// The transpose of this without a diagonal; v is overwritten.
  void precondition_transpose(Vector v, Vector out) {
    project_solution(v);
    system_.preconditioner()->apply_transpose(v, out);
  }
  void divide_by_diagonal(const T* b, Vector c) { system_.a().divide_by_diagonal(b, c); }
  /// n Jacobi sweeps of x, for which next is memory; and one from x to next, which returns ‖b - A x‖². With omega,
  /// Chebyshev's, where next holds the iterate before x, on entry and (of the n) on return.
  void sweeps(const T* c, Vector& x, Vector& next, int64_t n, const T* omega) {
    for (int64_t part; n > 0; n -= part) {
      part = std::min(n, interruption::Watch::at_once(system_.a().work()));
      count(part);
      system_.a().jacobi_sweeps(c, x, next, part, omega);
      if (omega) omega += part;
    }
  }
  Scalar measured_sweep(const T* c, const T* x, Vector next, const T* omega) {
    count(1);
    return system_.a().jacobi_sweep(c, x, next, omega);
  }
  /// The square of the spectral radius of I - D⁻¹A; solve() sees to it that there is one.
  Scalar radius2() const {
    const double radius = system_.a().radius().value_or(0.0);
    return static_cast<T>(radius * radius);
  }
  /// Whether the norms of Jacobi's residuals are a convex sequence on a logarithmic scale.
  bool sweeps_are_log_convex() const { return system_.a().radius().has_value(); }
  /// r = b - A u, within the range of A, where u is x and the start; returns ‖r‖².
  Scalar residual(const T* x, Vector r) {
    apply(solution(x), r);
    const T* const of = started_ ? original_b() : b();
    const T one = 1;
    const Scalar rr = vectors_.multi_axpy(T(1), &one, &of, 1, T(-1), r, length());
    if (!system_.a().left_null_space()) return rr;
    project(r);
    return dot(r, r);
  }
  /// ‖u‖²
  Scalar solution2(const T* x) {
    const T* u = solution(x);
    return dot(u, u);
  }
  Scalar componentwise_scale2(const T* x, int64_t attempt) {
    kernels::Workspace<T> memory;
    memory.prepare(2, length(), layout().halo);
    if (const char* kept = attempt == 0 ? first_signs(unknowns()) : nullptr)
      apply_with_signs(solution(x), [kept](int64_t i) { return kept[i] != 0; }, memory);
    else apply_with_signs(solution(x), [attempt](int64_t i) { return is_negated_in(attempt, i); }, memory);
    return dot(memory.vector(1), memory.vector(1));
  }
  /// Seldom: as many products, and then as many solves, as there are patterns.
  Scalar skeel_estimate2(const T* x) {
    kernels::Workspace<T> memory;
    memory.prepare(2, length(), layout().halo);
    std::vector<T> values(unknowns()), scale2(unknowns(), T(0));  // of |A| |u|
    for (int64_t p = 0; p < kSignPatterns; ++p) {
      apply_with_signs(solution(x), [p](int64_t i) { return is_negated(i, p); }, memory);
      layout().store(memory.vector(1), T(1), values.data());
      for (int64_t i = 0; i < unknowns(); ++i) scale2[i] += values[i] * values[i];
    }
    T largest = 0;
    for (int64_t p = 0; p < kSignPatterns; ++p) {
      for (int64_t i = 0; i < unknowns(); ++i)
        values[i] = (is_negated(unknowns() + i, p) ? -1 : 1) * std::sqrt(scale2[i] / T(kSignPatterns));
      layout().load(values.data(), T(1), memory.vector(0));
      if (!system_.factors().solve(memory.vector(0), memory.vector(1))) return std::numeric_limits<T>::infinity();
      largest = std::max(largest, dot(memory.vector(1), memory.vector(1)));
    }
    return largest;
  }
  std::array<bool, 1> surely_definite() const { return {system_.a().is_surely_definite()}; }
  std::array<bool, 1> definite_factors(Vector x) { return {system_.a().has_definite_factors(x, b())}; }
  void solve_directly(const T* r, Vector d) {
    if (system_.factors().solve(r, d)) return;
    broken_ = true;
    fill_zero(d);
  }

  /// What GMRES needs: linear combinations of several vectors.
  void dots(const std::vector<Vector>& v, int64_t count, Scalar factor, const T* w, Scalar* h) {
    vectors_.multi_dot(v.data(), count, factor, w, h, length());
  }
  /// w = factor w - Σ h_i v_i; returns ‖w‖². And x += Σ y_i v_i.
  Scalar subtract_combination(const Scalar* h, const std::vector<Vector>& v, int64_t count, Scalar factor, Vector w) {
    return vectors_.multi_axpy(T(-1), h, v.data(), count, factor, w, length());
  }
  void add_combination(const Scalar* y, const std::vector<Vector>& v, int64_t count, Vector x) {
    vectors_.multi_axpy(T(1), y, v.data(), count, T(1), x, length());
  }
  void damp(const Scalar* r, const Scalar* g, int64_t n, Scalar scale, Scalar keep, Scalar* y) const {
    if (keep != 0) return;
    std::vector<T> work(numbers_of_solve_damped(n));
    solve_damped(r, g, n, std::numeric_limits<T>::epsilon() * scale, y, work.data());
  }
  Scalar enough2() const { return static_cast<T>(state_->enough2); }
  using SampleNumbers<T>::restore;
  void restore(Scalar where, const T* from, Vector to) {
    if (where != 0) copy(from, to);
  }

  std::array<double, 1> operator_norm() const { return {system_.a().norm()}; }
  void reset() {
    broken_ = false;
    workspace_.clear(1);
    clear(own_);
  }
  /// Zeroes the vectors from number `first` on, with their padding.
  void clear(int64_t first = 0) {
    for (int64_t i = first; i < workspace_.count(); ++i) workspace_.clear(i);
  }

 private:
  const kernels::Layout<T>& layout() const { return system_.a().layout(); }
  int64_t length() const { return system_.a().length(); }
  const T* solution(const T* x) {
    if (!started_) return x;
    copy(x, scratch());
    add(start(), scratch());
    return scratch();
  }
  /// Removes the component of v in null(Aᵀ) if it is above ε/8 ‖v‖, where ‖v‖² = vv; returns the new ‖v‖².
  Scalar projected(Vector v, Scalar vv) {
    constexpr T negligible = std::numeric_limits<T>::epsilon() / 8;  // of ‖v‖
    const T part = system_.a().left_null_space()->project(v, negligible * std::sqrt(vv));
    return part * part < vv / 2 ? vv - part * part : dot(v, v);
  }
  /// In vector 1, A times v with signs changed.
  template <class Negated>
  void apply_with_signs(const T* v, const Negated& negated, kernels::Workspace<T>& memory) {
    std::vector<T> values(unknowns());
    layout().store(v, T(1), values.data());
    for (int64_t i = 0; i < unknowns(); ++i)
      if (negated(i)) values[i] = -values[i];
    layout().load(values.data(), T(1), memory.vector(0));
    system_.a().apply(memory.vector(0), memory.vector(1));
  }
  void count(int64_t products) {
    watch_.spend(products * system_.a().work());
    state_->applications += products;
  }

  interruption::Watch& watch_ = interruption::Watch::local();
  kernels::WholeVectors<T> vectors_;
  const SampleSystem<T>& system_;
  kernels::Workspace<T>& workspace_;
  SampleState* state_ = nullptr;
  int64_t own_, used_;
  T b2_ = 0;
  bool started_ = false;  // from start(), and then original_b() is what b() was
};

}  // namespace prdp
