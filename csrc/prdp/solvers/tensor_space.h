#pragma once
#include <ATen/ATen.h>

#include <array>
#include <vector>

#include "prdp/operators/operator.h"
#include "prdp/operators/sums_in_order.h"
#include "prdp/solvers/batch_loops.h"
#include "prdp/solvers/iterate.h"
#include "prdp/solvers/solver.h"
#include "prdp/solvers/space.h"
#include "prdp/solvers/tensor_preconditioner.h"
#include "prdp/threads/interruption.h"

namespace prdp {

/// A whole batch as a space for iterate(), in plain tensor operations: it serves every device,
/// operators without CPU loops, and, run under autograd, the derivative of the iterations. No vector
/// is written in place but by batch_loops. A frozen sample keeps its values by at::where.
///
/// The operations stand in the groups of space.h, which says what each does.
class TensorSpace : public SpaceDefaults<TensorSpace> {
 public:
  using Vector = at::Tensor;  // (batch, ...)
  using Scalar = at::Tensor;  // (batch, 1, ...)
  using States = std::vector<SampleState>;

  // ---- the system

  /// A and the preconditioner (an empty `inverse`: none, or the diagonal). The first apply() and precondition() set a
  /// power of two per sample that keeps later products in range.
  struct System {
    const Operator& a;
    const Preconditioner& preconditioner;
    TensorPreconditioner inverse{};
    at::Tensor scale_of_a{}, scale_of_inverse{};  // (batch, 1, …); undefined before that
  };
  /// b must be finite and scaled to the order of one, or zero. While autograd is `recording`, nothing but torch's own
  /// operations is used.
  TensorSpace(System& system, at::Tensor b, States& states, bool recording = false);
  /// Starts from x, which leaves r of b: from here on b() is r, and what the method looks for is added to x.
  void start_from(at::Tensor x, at::Tensor r);
  /// Whether batch_loops compute, on contiguous vectors.
  bool in_loops() const { return in_loops_; }
  /// Squared norms below this are zero to the dtype.
  double negligible() const { return negligible_; }

  // ---- primitives

  Vector vector() const { return at::zeros_like(b_); }
  const Vector& b() const { return b_; }
  const Scalar& b2() const { return b2_; }
  int64_t unknowns() const { return b_.numel() / std::max<int64_t>(b_.size(0), 1); }
  double unit_roundoff() const;
  template <class X>
  std::vector<X> array(int64_t n) const {
    return std::vector<X>(n);
  }
  void fill_zero(Vector& v) { v = at::zeros_like(b_); }
  void copy(const Vector& from, Vector& to) { to = keep_frozen(from, to); }
  void advance(Vector& x, Vector& next) {
    const auto before = x;
    x = keep_frozen(next, x);
    next = before;
  }
  void add(const Vector& d, Vector& x) { x = keep_frozen(x + d, x); }
  void xpby(const Vector& x, const Scalar& beta, Vector& y) {
    if (in_loops_) return batch_loops::xpby(x, beta, y, active_);
    y = keep_frozen(at::addcmul(x, beta, y), y);
  }
  Scalar dot(const Vector& v, const Vector& w) const { return in_loops_ ? batch_loops::dot(v, w) : dot_in_order(v, w); }
  Scalar update_iterate_and_residual(const Scalar& alpha, const Vector& p, const Vector& q, Vector& x, Vector& r);
  void apply(const Vector& v, Vector& out);
  Scalar residual(const Vector& x, Vector& r);
  void keep_in_range(Vector& v) const {
    if (system_.a.needs_projection()) v = keep_frozen(system_.a.project(v), v);
  }
  bool is_preconditioned() const { return static_cast<bool>(system_.preconditioner); }
  Scalar precondition(const Vector& v, Vector& out);

  // ---- fused operations

  std::array<Scalar, 2> apply_with_dots(const Vector& v, Vector& out) {
    return in_loops_ ? apply_along(v, v, out) : SpaceDefaults::apply_with_dots(v, out);
  }
  std::array<Scalar, 2> apply_along(const Vector& v, const Vector& w, Vector& out);
  void apply_cycle(const Vector& v, Vector& out);

  // ---- numbers, one per sample

  void assign(const Scalar& from, Scalar& to) { to = keep_frozen(from, to); }
  Scalar guarded_quotient(const Scalar& num, const Scalar& den, const Scalar& v2, const Scalar& w2);
  Scalar breaks_down(const Scalar& den, const Scalar& v2, const Scalar& w2, const Scalar& active) const;
  Scalar ratio(const Scalar& num, const Scalar& den);
  void break_down_unless_positive(const Scalar& a, const Scalar& v2) {
    note_broken(a.detach().gt(0).logical_or(v2.detach().lt(negligible_)).logical_not());
  }
  Scalar sum_of_squares(const Scalar& v2, const Scalar& a, const Scalar& w2) {
    return in_loops_ ? batch_loops::sum_of_squares(v2, a, w2) : v2 + a * a * w2;
  }
  Scalar is_rounding(const Scalar& a, const Scalar& v2, const Scalar& w2, double factor) {
    return is_larger(v2.detach().sqrt() * w2.detach().sqrt() * factor, a.detach().abs());
  }
  Scalar unless_zero(const Scalar& a, const Scalar& b, const Scalar& active) {
    return at::where(b.ne(0).logical_and(active.ne(0)), a, at::zeros_like(a));
  }
  Scalar is_zero(const Scalar& a) const { return a.eq(0).to(b_.scalar_type()); }
  Scalar is_not_zero(const Scalar& a) const { return a.ne(0).to(b_.scalar_type()); }
  Scalar is_larger(const Scalar& a, const Scalar& b) const { return a.gt(b).to(b_.scalar_type()); }
  void restore(const Scalar& where, const at::Tensor& from, at::Tensor& to) {
    if (in_loops_ && !batch_loops::any(where)) return;
    to = at::where(where.ne(0), from, to);
  }

  // ---- sweeps

  void divide_by_diagonal(const Vector& b, Vector& c) { c = b / diagonal(); }
  void sweeps(const Vector& c, Vector& x, Vector& y, int64_t n, const Scalar* omega) {
    for (int64_t s = 0; s < n; ++s) {
      y = swept(x, jacobi_change(c, x), /*before=*/y, omega ? omega + s : nullptr);
      advance(x, y);
    }
  }
  Scalar measured_sweep(const Vector& c, const Vector& x, Vector& y, const Scalar* omega);
  Scalar radius2() const { return system_.a.jacobi_radius().square(); }
  static constexpr bool sweeps_are_log_convex() { return false; }  // not known of the operator

  // ---- GMRES and MINRES (tensor_space_basis.cpp)

  void dots(const std::vector<Vector>& v, int64_t count, const Scalar& factor, const Vector& w, Scalar* h) const;
  Scalar subtract_combination(const Scalar* h, const std::vector<Vector>& v, int64_t count, const Scalar& factor,
                              Vector& w) const;
  void add_combination(const Scalar* h, const std::vector<Vector>& v, int64_t count, Vector& x);
  bool lost_orthogonality(const Scalar&, const Scalar&, const Scalar&) const { return true; }  // for some sample
  Scalar inverse(const Scalar& a, const Scalar& scale) const;
  Scalar larger(const Scalar& a, const Scalar& b) const { return at::maximum(a, b); }
  void damp(const Scalar* R, const Scalar* g, int64_t n, const Scalar& scale, const Scalar& keep, Scalar* h) const;
  bool surely_all(const Scalar&) const { return false; }
  bool all_ended(const Scalar& ended);
  bool all_ended(const std::vector<bool>& ended);
  Scalar constant(const Scalar& a) const { return a.detach(); }
  Scalar enough2() const;
  double enough2_of(int64_t sample) const { return states_[sample].enough2; }
  int derivatives() const { return recording_ ? 2 : 0; }
  bool started() const { return start_.defined(); }

  // ---- direct methods

  void solve_directly(const Vector& r, Vector& d);
  Scalar skeel_estimate2(const Vector& x) const;

  // ---- the loop around the methods

  std::vector<double> values_of(const Scalar& value) const;
  std::vector<bool> broken() const;
  const std::vector<double>& operator_norm();
  std::vector<bool> surely_definite() const { return std::vector<bool>(states_.size()); }
  std::vector<bool> definite_factors(const Vector&) const { return surely_definite(); }
  /// u = start + scale_of_a x: the solution for the A that is not scaled.
  Vector solution(const Vector& x) const;
  Vector in_units_of_x(const Vector& u) const { return system_.scale_of_a.defined() ? u / system_.scale_of_a : u; }
  /// Scaled as A is, so that no square of a small u underflows.
  Scalar solution2(const Vector& x) const {
    const auto u = in_units_of_x(solution(x));
    return dot(u, u);
  }
  Scalar componentwise_scale2(const Vector& x, int64_t attempt) const;
  Vector scratch() const { return vector(); }
  template <class Predicate>
  void freeze_unless(const States& states, const Predicate& predicate) {
    set_active(map(states, [&](const SampleState& s) -> bool { return predicate(s); }));
  }
  template <class Function>
  auto map(const States& states, const Function& f) const {
    std::vector<decltype(f(states[0]))> values;
    for (const auto& s : states) values.push_back(f(s));
    return values;
  }
  Vector select(const std::vector<bool>& wanted, const Vector& kept, const Vector& x) const;
  void reset();

 private:
  // ---- frozen samples, and broken ones
  at::Tensor keep_frozen(const at::Tensor& updated, const at::Tensor& old) const {
    return active_mask_.defined() ? at::where(active_mask_, updated, old) : updated;
  }
  void set_active(const std::vector<bool>& active);
  at::Tensor mask_of(const std::vector<bool>& rows) const;
  void note_broken(const at::Tensor& rows);

  // ---- products with A
  bool is_active(size_t sample) const { return active_.empty() || active_[sample]; }
  /// A v, not scaled, and counted.
  Vector product(const Vector& v);
  /// The same; from then on, the scale of A is known.
  Vector product_setting_scale(const Vector& v);
  /// Sets the scale that brings the product to the order of v, if it is not known yet.
  void define_scale(const Vector& product, const Vector& v, at::Tensor& scale) const;
  void check_scale(const at::Tensor& scale) const;
  /// Contiguous, which batch_loops require.
  Vector laid_out(const Vector& v) const { return in_loops_ ? v.contiguous() : v; }

  // ---- the diagonal
  /// D. Zeros are replaced by 1: those samples are refused, and a division by 0 would send NaN through the mask in the
  /// backward pass.
  const at::Tensor& diagonal();
  Vector jacobi_change(const Vector& c, const Vector& x) { return at::addcdiv(c, product(x), diagonal(), -1); }
  Vector swept(const Vector& x, const Vector& change, const Vector& before, const Scalar* omega) const;
  /// A CPU scalar in a solve on another device, such as the diagonal of a plain nu. It is passed as a number: as a
  /// tensor, torch would refuse or copy it.
  bool is_number_of_host(const at::Tensor& t) const {
    return !b_.is_cpu() && !recording_ && t.is_cpu() && t.dim() == 0;
  }

  /// What is zero beside the product of two factors, by the squares of their norms.
  at::Tensor rounding_of(const Scalar& v2, const Scalar& w2) const;

  System& system_;
  at::Tensor b_, b2_, diagonal_;
  at::Tensor start_, given_b_;  // undefined: from zero
  States& states_;
  std::vector<bool> active_;
  std::vector<bool> ended_;  // whose cycle is over; empty: of none
  at::Tensor active_mask_;  // undefined: every sample is active
  at::Tensor broken_;       // undefined: no breakdown so far
  double negligible_;
  std::vector<double> norms_;  // ‖A‖ of each sample, once asked for
  // Who computes: torch's operations, which autograd records, or batch_loops, or torch's operations unrecorded.
  bool recording_;
  bool in_loops_;
};

}  // namespace prdp
