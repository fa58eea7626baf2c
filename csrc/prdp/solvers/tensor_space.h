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
/// operators without CPU loops, and, run under autograd, the derivative of the iterations. Nothing
/// is written in place but by batch_loops. A frozen sample keeps its values by at::where.
class TensorSpace : public SpaceDefaults<TensorSpace> {
 public:
  using Vector = at::Tensor;  // (batch, ...)
  using Scalar = at::Tensor;  // (batch, 1, ...)
  using States = std::vector<SampleState>;

  /// What a solve computes with: A, and the inverse of the preconditioner unless it is the diagonal. Both are scaled by
  /// a power of two for each sample, which their first product gives: so no product of theirs over- or underflows.
  struct System {
    const Operator& a;
    const Preconditioner& preconditioner;
    TensorPreconditioner inverse{};
    at::Tensor scale_of_a{}, scale_of_inverse{};  // (batch, 1, …); undefined before the first product
  };
  /// b must be finite and scaled to the order of one, or zero.
  TensorSpace(System& system, at::Tensor b, States& states, bool recording = false);
  /// Starts from x, which leaves r of b: from here on b() is r, and what the method looks for is added to x.
  void start_from(at::Tensor x, at::Tensor r);

  Vector vector() const { return at::zeros_like(b_); }
  Vector scratch() const { return vector(); }
  const Vector& b() const { return b_; }
  const Scalar& b2() const { return b2_; }
  int64_t unknowns() const { return b_.numel() / std::max<int64_t>(b_.size(0), 1); }
  double epsilon() const;
  template <class X>
  std::vector<X> array(int64_t n) const {
    return std::vector<X>(n);
  }
  /// Numbers below this are zero to the dtype.
  double negligible() const { return negligible_; }

  void fill_zero(Vector& v) { v = at::zeros_like(b_); }
  void copy(const Vector& from, Vector& to) { to = keep_frozen(from, to); }
  void assign(const Scalar& from, Scalar& to) { to = keep_frozen(from, to); }
  /// x takes the value of next, and next that of x.
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
  Scalar dot(const Vector& a, const Vector& b) const { return in_loops_ ? batch_loops::dot(a, b) : dot_in_order(a, b); }
  Scalar update_iterate_and_residual(const Scalar& alpha, const Vector& p, const Vector& q, Vector& x, Vector& r) {
    if (in_loops_ && !system_.a.needs_projection())
      return batch_loops::update_iterate_and_residual(alpha, p, q, x, r, active_);
    x = keep_frozen(at::addcmul(x, alpha, p), x);
    const auto left = at::addcmul(r, alpha, q, -1);
    r = keep_frozen(system_.a.needs_projection() ? system_.a.project(left) : left, r);
    return dot(r, r);
  }

  void apply(const Vector& v, Vector& out) {
    const auto made = unscaled_product(v);
    if (in_loops_) return batch_loops::scale(system_.scale_of_a, made, out);
    out = made * system_.scale_of_a;
  }
  std::array<Scalar, 2> apply_with_dots(const Vector& v, Vector& out) {
    return in_loops_ ? apply_along(v, v, out) : SpaceDefaults::apply_with_dots(v, out);
  }
  std::array<Scalar, 2> apply_along(const Vector& v, const Vector& w, Vector& out) {
    if (in_loops_) return batch_loops::scale_with_dots(system_.scale_of_a, unscaled_product(v), w, out);
    apply(v, out);
    return {dot(w, out), dot(out, out)};
  }
  Scalar sum_of_squares(const Scalar& rr, const Scalar& beta, const Scalar& pp) {
    if (in_loops_) return batch_loops::sum_of_squares(rr, beta, pp);
    return rr + beta * beta * pp;
  }
  bool is_preconditioned() const { return static_cast<bool>(system_.preconditioner); }
  Scalar precondition(const Vector& v, Vector& out);
  void correct(const Vector& v, Vector& out) {
    const auto z = laid_out(system_.inverse(v));
    out = keep_frozen(system_.a.needs_projection() ? system_.a.project_solution(z) : z, out);
  }
  void divide_by_diagonal(const Vector& b, Vector& c) { c = b / diagonal(); }
  void sweeps(const Vector& c, Vector& x, Vector& next, int64_t n, const Scalar* omega) {
    for (int64_t s = 0; s < n; ++s) {
      next = swept(x, jacobi_change(c, x), next, omega ? omega + s : nullptr);
      advance(x, next);
    }
  }
  Scalar measured_sweep(const Vector& c, const Vector& x, Vector& next, const Scalar* omega) {
    const auto change = jacobi_change(c, x);
    next = swept(x, change, next, omega);
    const auto r = diagonal() * change;
    return dot(r, r);
  }
  Scalar radius2() const { return system_.a.jacobi_radius().square(); }
  static constexpr bool sweeps_contract() { return false; }  // not known of the operator
  Scalar residual(const Vector& x, Vector& r) {
    const auto ax = product(solution(x));
    r = keep_frozen(system_.a.project((start_.defined() ? whole_b_ : b_) - ax), r);
    return dot(r, r);
  }
  bool started() const { return start_.defined(); }
  /// u, which is x and the start where A is not scaled.
  Vector solution(const Vector& x) const {
    const auto from_zero = system_.scale_of_a.defined() ? x * system_.scale_of_a : x;
    return start_.defined() ? start_ + from_zero : from_zero;
  }
  Scalar solution2(const Vector& x) const {
    const auto u = solution(x);
    return dot(u, u);
  }
  Scalar terms2(const Vector& x) const;
  void solve_directly(const Vector& r, Vector& d);

  Scalar guarded_quotient(const Scalar& num, const Scalar& den, const Scalar& a2, const Scalar& b2);
  Scalar breaks_down(const Scalar& den, const Scalar& a2, const Scalar& b2, const Scalar& active) const;
  Scalar ratio(const Scalar& num, const Scalar& den);
  void break_down_unless_positive(const Scalar& a, const Scalar& r2) {
    note_broken(a.detach().gt(0).logical_or(r2.detach().lt(negligible_)).logical_not());
  }
  Scalar is_rounding(const Scalar& a, const Scalar& b2, const Scalar& c2, double factor) {
    return is_larger(b2.detach().sqrt() * c2.detach().sqrt() * factor, a.detach().abs());
  }
  Scalar unless_zero(const Scalar& value, const Scalar& a, const Scalar& b) {
    return value * (is_not_zero(a) * is_not_zero(b));
  }

  /// While autograd records, numbers that are to be constants are detached.
  int derivatives() const { return recording_ ? 2 : 0; }
  Scalar constant(const Scalar& value) const { return value.detach(); }
  void dots(const std::vector<Vector>& v, int64_t count, const Scalar& factor, const Vector& w, Scalar* h) const {
    if (in_loops_) return batch_loops::dots(v, count, factor, w, h);
    const auto scaled = factor * w.detach();
    for (int64_t i = 0; i < count; ++i) h[i] = dot(v[i].detach(), scaled);
  }
  Scalar subtract_combination(const Scalar* h, const std::vector<Vector>& v, int64_t count, const Scalar& factor,
                              Vector& w) const {
    if (in_loops_) return batch_loops::combine(-1.0, h, v, count, &factor, w, {});
    w = factor * w;
    for (int64_t i = 0; i < count; ++i) w = at::addcmul(w, h[i], v[i], -1);
    return dot(w.detach(), w.detach());
  }
  void add_combination(const Scalar* y, const std::vector<Vector>& v, int64_t count, Vector& x) {
    if (in_loops_) return void(batch_loops::combine(1.0, y, v, count, nullptr, x, active_));
    auto sum = x;
    for (int64_t i = 0; i < count; ++i) sum = at::addcmul(sum, y[i], v[i]);
    x = keep_frozen(sum, x);
  }
  bool lost_orthogonality(const Scalar&, const Scalar&, const Scalar&) const { return true; }  // for some sample
  Scalar inverse(const Scalar& value, const Scalar& scale) const;
  void damp(const Scalar* r, int64_t stride, const Scalar* g, int64_t n, const Scalar& scale, const Scalar& keep,
            Scalar* y) const;
  Scalar larger(const Scalar& a, const Scalar& b) const { return at::maximum(a, b); }
  Scalar is_larger(const Scalar& a, const Scalar& b) const { return a.gt(b).to(b_.scalar_type()); }
  void restore(const Scalar& where, const at::Tensor& from, at::Tensor& to) {
    if (in_loops_ && !batch_loops::any(where)) return;
    to = at::where(where.ne(0), from, to);
  }
  Scalar is_zero(const Scalar& value) const { return value.eq(0).to(b_.scalar_type()); }
  Scalar is_not_zero(const Scalar& value) const { return value.ne(0).to(b_.scalar_type()); }
  bool surely_all(const Scalar&) const { return false; }  // the basis goes on with zeros

  std::vector<double> values_of(const Scalar& value) const;
  std::vector<bool> broken() const;
  std::vector<double> operator_norm() const;
  template <class Predicate>
  void freeze_unless(const States& states, const Predicate& predicate) {
    std::vector<bool> wanted;
    for (const auto& s : states) wanted.push_back(predicate(s));
    set_active(wanted);
  }
  template <class Function>
  auto map(const States& states, const Function& f) const {
    std::vector<decltype(f(states[0]))> values;
    for (const auto& s : states) values.push_back(f(s));
    return values;
  }
  /// Rows of `remade` where a sample was solved again in the last pass, rows of `kept` elsewhere.
  Vector select(const std::vector<bool>& remade_rows, const Vector& kept, const Vector& remade) const;
  void reset();
  /// On another device, where each operation of torch is a launch.
  bool is_far() const { return !b_.is_cpu() && !recording_; }

 private:
  at::Tensor keep_frozen(const at::Tensor& updated, const at::Tensor& old) const {
    return active_mask_.defined() ? at::where(active_mask_, updated, old) : updated;
  }
  /// As batch_loops take it.
  Vector laid_out(const Vector& v) const { return in_loops_ ? v.contiguous() : v; }
  Vector swept(const Vector& x, const Vector& change, const Vector& before, const Scalar* omega) const {
    if (!omega) return x + change;
    const auto step = x + change - before;
    if (is_number_of_host(*omega)) return at::add(before, step, omega->item());
    return at::addcmul(before, omega->to(b_.options()), step);
  }
  /// As a plain nu leaves: an argument of operations on another device, not a tensor beside those there.
  bool is_number_of_host(const at::Tensor& t) const { return is_far() && t.is_cpu() && t.dim() == 0; }
  Vector jacobi_change(const Vector& c, const Vector& x) { return at::addcdiv(c, product(x), diagonal(), -1); }
  /// D; 1 in place of its zeros, whose samples are refused: no NaN comes from behind their mask.
  const at::Tensor& diagonal();
  /// A v, not scaled.
  Vector product(const Vector& v) {
    count();
    return laid_out(system_.a.apply(in_loops_ ? v.detach() : v));  // a handle of its own, which a product may keep
  }
  /// The same; from then on, the scale of A is known.
  Vector unscaled_product(const Vector& v) {
    auto made = product(v);
    define_scale(made, v, system_.scale_of_a);
    return made;
  }
  /// Sets the scale that brings the product to the order of v, if it is not known yet.
  void define_scale(const Vector& product, const Vector& v, at::Tensor& scale) const;
  void check_scale(const at::Tensor& scale) const;
  void note_broken(const at::Tensor& rows) {
    const auto now = active_mask_.defined() ? rows.logical_and(active_mask_) : rows;
    broken_ = broken_.defined() ? broken_.logical_or(now) : now;
  }
  /// What is zero beside the product of two factors, by the squares of their norms.
  at::Tensor rounding_of(const Scalar& a2, const Scalar& b2) const;
  void set_active(const std::vector<bool>& active);
  void count();
  at::Tensor mask_of(const std::vector<bool>& rows) const;

  System& system_;
  at::Tensor b_, b2_, diagonal_;
  at::Tensor start_, whole_b_;  // undefined: from zero
  States& states_;
  std::vector<bool> active_;
  at::Tensor active_mask_;  // undefined: every sample is active
  at::Tensor broken_;       // undefined: no breakdown so far
  double negligible_;
  bool recording_, in_loops_;
};

}  // namespace prdp
