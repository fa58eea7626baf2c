#pragma once
#include <algorithm>
#include <array>
#include <vector>

#include "prdp/autograd/tape.h"
#include "prdp/solvers/sample_space.h"

namespace prdp {

/// A sample as a space whose operations can be taken back. A method runs in it as in any other. While it records, every
/// operation whose old values a derivative needs writes to new memory and notes on the tape what it did; so no method
/// needs a derivative of its own.
template <class T>
class TapeSpace : public SpaceDefaults<TapeSpace<T>> {
 public:
  using Scalar = TapeNumber<T>;
  /// The version that it holds now, and the one whose memory it uses while nothing is recorded.
  struct Vector {
    int32_t version = -1, home = -1;
    bool operator==(const Vector& other) const { return version == other.version; }
  };

  TapeSpace(Tape<T>& tape, SampleSpace<T>& values) : tape_(tape), values_(values) {
    b_.version = tape_.add_version(values.b());
    b2_ = number(Kind::kSquare, values.b2(), b_.version);
  }
  TapeSpace(const TapeSpace&) = delete;

  void record(bool on) { recording_ = on; }
  const T* value(const Vector& v) const { return tape_.value(v.version); }
  T* value(const Vector& v) { return tape_.value(v.version); }
  /// Puts a state back, as the beginning of what comes next; null: nobody reads its value.
  void set(Vector& v, const T* from) {
    v.version = v.home;
    tape_.begin_version(v.home, from != nullptr);
    if (from) copy_values(from, value(v));
  }
  void set(Scalar& number, T value) { number = recording_ ? Scalar(value, tape_.numbers) : Scalar(value); }

  // The operations stand in the groups of solvers/space.h, which says what each does.

  // ---- primitives

  Vector vector() {
    const auto home = tape_.add_version();
    return {home, home};
  }
  Vector b() const { return b_; }
  Scalar b2() const { return b2_; }
  int64_t unknowns() const { return values_.unknowns(); }
  double unit_roundoff() const { return values_.unit_roundoff(); }
  template <class X>
  std::vector<X> array(int64_t n) const {
    return std::vector<X>(n);
  }
  void fill_zero(Vector& v) {
    if (recording_) v.version = Tape<T>::kZero;
    else values_.fill_zero(fresh(v));
  }
  void copy(const Vector& from, Vector& to) {
    if (recording_) to.version = from.version;
    else copy_values(value(from), fresh(to));
  }
  void advance(Vector& x, Vector& next) { std::swap(x, next); }
  void add(const Vector& d, Vector& x) {
    const auto before = x.version;
    values_.add(value(d), changed(x));
    note({.kind = Kind::kAxpy, .out = x.version, .a = before, .b = d.version});
  }
  void xpby(const Vector& x, const Scalar& beta, Vector& y) {
    const auto before = y.version;
    values_.xpby(value(x), beta.value, changed(y));
    note({.kind = Kind::kAxpy,
          .out = y.version,
          .a = x.version,
          .b = before,
          .factor_node = beta.node,
          .factor = beta.value});
  }
  Scalar dot(const Vector& a, const Vector& b) {
    return number(Kind::kDot, values_.dot(value(a), value(b)), a.version, b.version);
  }
  Scalar update_iterate_and_residual(const Scalar& alpha, const Vector& p, const Vector& q, Vector& x, Vector& r) {
    const auto p_then = p.version, x_before = x.version, r_before = r.version;
    const T* direction = value(p);
    T* const x_now = changed(x);
    const T rr = values_.update_iterate_and_residual(alpha.value, direction, value(q), x_now, changed(r));
    note({.kind = Kind::kAxpy,
          .out = x.version,
          .a = x_before,
          .b = p_then,
          .factor_node = alpha.node,
          .factor = alpha.value});
    note({.kind = Kind::kAxpy,
          .out = r.version,
          .a = r_before,
          .b = q.version,
          .factor_node = alpha.node,
          .factor = alpha.value,
          .sign = -1});
    return number(Kind::kSquare, rr, r.version);
  }
  void apply(const Vector& v, Vector& out) {
    const T* from = value(v);
    const auto of = v.version;
    values_.apply(from, fresh(out));
    note({.kind = Kind::kApply, .out = out.version, .a = of});
  }
  Scalar residual(const Vector& x, Vector& r) {
    const T* from = value(x);
    const auto of = x.version;
    const T rr = values_.residual(from, fresh(r));
    note({.kind = Kind::kResidual, .out = r.version, .a = of});
    return number(Kind::kSquare, rr, r.version);
  }
  bool is_preconditioned() const { return values_.is_preconditioned(); }
  Scalar precondition(const Vector& v, Vector& out) {
    const T* from = value(v);
    const auto of = v.version;
    const T product = values_.precondition(from, fresh(out));
    note({.kind = values_.is_preconditioned_by_diagonal() ? Kind::kDivide : Kind::kPrecondition,
          .out = out.version,
          .a = of});
    return number(Kind::kDot, product, of, out.version);
  }

  // ---- fused operations

  Scalar xpby_with_square(const Vector& x, const Scalar& beta, Vector& y) {
    xpby(x, beta, y);
    return number(Kind::kSquare, values_.dot(value(y), value(y)), y.version);
  }
  std::array<Scalar, 2> apply_with_dots(const Vector& v, Vector& out) {
    const T* from = value(v);
    const auto of = v.version;
    const auto dots = values_.apply_with_dots(from, fresh(out));
    note({.kind = Kind::kApply, .out = out.version, .a = of});
    const auto first = number(Kind::kDot, dots[0], of, out.version);
    return {first, number(Kind::kSquare, dots[1], out.version)};
  }
  void keep_in_range(Vector& v) { values_.keep_in_range(value(v)); }  // takes rounding off: not recorded

  // ---- numbers

  void assign(const Scalar& from, Scalar& to) { to = from; }
  Scalar guarded_quotient(const Scalar& num, const Scalar& den, const Scalar& v2, const Scalar& w2) {
    const T value = values_.guarded_quotient(num.value, den.value, v2.value, w2.value);
    return value == T(0) ? Scalar(value) : num / den;
  }
  Scalar breaks_down(const Scalar& den, const Scalar& v2, const Scalar& w2, const Scalar& active) const {
    return values_.breaks_down(den.value, v2.value, w2.value, active.value);
  }
  Scalar ratio(const Scalar& num, const Scalar& den) const {
    const T value = values_.ratio(num.value, den.value);
    return value == T(0) ? Scalar(value) : num / den;
  }
  void break_down_unless_positive(const Scalar& a, const Scalar& r2) {
    values_.break_down_unless_positive(a.value, r2.value);
  }
  Scalar sum_of_squares(const Scalar& v2, const Scalar& a, const Scalar& w2) const {
    return values_.sum_of_squares(v2.value, a.value, w2.value);
  }
  Scalar is_rounding(const Scalar& a, const Scalar& v2, const Scalar& w2, double factor) const {
    return values_.is_rounding(a.value, v2.value, w2.value, factor);
  }
  Scalar unless_zero(const Scalar& a, const Scalar& b, const Scalar& active) const {
    return b.value != 0 && active.value != 0 ? a : Scalar(0);
  }
  Scalar is_not_zero(const Scalar& a) const { return values_.is_not_zero(a.value); }
  Scalar is_zero(const Scalar& a) const { return values_.is_zero(a.value); }
  Scalar is_larger(const Scalar& a, const Scalar& b) const { return values_.is_larger(a.value, b.value); }
  void restore(const Scalar& where, const Vector& from, Vector& to) {
    if (where.value != 0) copy(from, to);
  }
  void restore(const Scalar& where, const Scalar& from, Scalar& to) const {
    if (where.value != 0) to = from;
  }

  // ---- sweeps

  void divide_by_diagonal(const Vector& b, Vector& c) {
    const T* from = value(b);
    const auto of = b.version;
    values_.divide_by_diagonal(from, fresh(c));
    note({.kind = Kind::kDivide, .out = c.version, .a = of});
  }
  void sweeps(const Vector& c, Vector& x, Vector& next, int64_t n, const Scalar*) {
    if (recording_) {
      TORCH_INTERNAL_ASSERT(n == 1, "one sweep at a time is recorded");
      const auto before = x.version;
      values_.measured_sweep(value(c), value(x), fresh(next), nullptr);
      note({.kind = Kind::kSweep, .out = next.version, .a = c.version, .b = before});
      return std::swap(x, next);
    }
    T* now = changed(x);
    T* other = fresh(next);
    const T* const home = now;
    values_.sweeps(value(c), now, other, n, nullptr);
    if (now != home) std::swap(x, next);
  }
  Scalar measured_sweep(const Vector& c, const Vector& x, Vector& next, const Scalar*) {
    return values_.measured_sweep(value(c), value(x), fresh(next), nullptr);  // a residual alone; no derivative
  }
  Scalar radius2() const { return values_.radius2(); }
  bool sweeps_are_log_convex() const { return values_.sweeps_are_log_convex(); }

  // ---- GMRES; MINRES has no tape

  void dots(const std::vector<Vector>& v, int64_t count, const Scalar& factor, const Vector& w, Scalar* h) {
    plain_.resize(count);
    values_.dots(pointers(v, count), count, factor.value, value(w), plain_.data());
    std::copy(plain_.begin(), plain_.end(), h);
  }
  Scalar subtract_combination(const Scalar* h, const std::vector<Vector>& v, int64_t count, const Scalar& factor,
                              Vector& w) {
    return combine(-1, h, v, count, factor.value, w);
  }
  void add_combination(const Scalar* y, const std::vector<Vector>& v, int64_t count, Vector& x) {
    combine(1, y, v, count, 1, x);
  }
  bool lost_orthogonality(const Scalar& left2, const Scalar& taken2, Scalar& loss) const {
    return values_.lost_orthogonality(left2.value, taken2.value, loss.value);
  }
  Scalar inverse(const Scalar& a, const Scalar& scale) const { return values_.inverse(a.value, scale.value); }
  Scalar larger(const Scalar& a, const Scalar& b) const { return values_.larger(a.value, b.value); }
  void damp(const Scalar* r, const Scalar* g, int64_t n, const Scalar& scale, const Scalar& keep, Scalar* y) const {
    const auto plain = [](const Scalar* from, int64_t count) {
      std::vector<T> values(count);
      for (int64_t i = 0; i < count; ++i) values[i] = from[i].value;
      return values;
    };
    if (keep.value != 0) return;
    auto found = plain(y, n);
    const auto triangle = plain(r, hessenberg_column(n));
    values_.damp(triangle.data(), plain(g, n).data(), n, scale.value, keep.value, found.data());
    std::copy(found.begin(), found.end(), y);
  }
  bool surely_all(const Scalar& a) const { return values_.surely_all(a.value); }
  bool all_ended(const Scalar& ended) const { return values_.all_ended(ended.value); }
  Scalar constant(const Scalar& a) const { return a.value; }
  Scalar enough2() const { return values_.enough2(); }
  int derivatives() const { return recording_ ? 1 : 0; }
  bool started() const { return values_.started(); }

  // ---- direct methods, which have no derivative here

  void solve_directly(const Vector&, Vector&) { TORCH_INTERNAL_ASSERT(false, "no derivative of a direct method"); }
  Scalar skeel_estimate2(const Vector&) { TORCH_INTERNAL_ASSERT(false, "no derivative of a direct method"); }
  std::array<bool, 1> definite_factors(const Vector&) const { return {false}; }

 private:
  using Kind = typename Tape<T>::Kind;
  using Op = typename Tape<T>::Op;

  void copy_values(const T* from, T* to) { std::copy_n(from, tape_.length(), to); }
  /// Memory for a new value of v.
  T* fresh(Vector& v) {
    v.version = recording_ ? tape_.add_version() : v.home;
    return value(v);
  }
  /// The same for an operation in place: the new value begins as the old one. While recording, the old version stays
  /// for the way back and is copied; where the way back does not read it, the new version takes over its memory.
  T* changed(Vector& v) {
    T* const before = value(v);
    if (recording_ && !tape_.is_read(v.version)) {
      v.version = tape_.add_unread(before);
      return before;
    }
    T* const after = fresh(v);
    if (after != before) copy_values(before, after);
    return after;
  }
  C10_ALWAYS_INLINE void note(Op op) {
    if (!recording_) return;
    op.numbers = tape_.numbers.size();
    tape_.ops.push(op);
  }
  Scalar number(Kind kind, T value, int32_t a, int32_t b = -1) {
    if (!recording_) return value;
    note({.kind = kind, .a = a, .b = b, .made = tape_.numbers.size()});
    return {value, tape_.numbers};
  }
  const std::vector<T*>& pointers(const std::vector<Vector>& v, int64_t count) {
    pointers_.resize(count);
    for (int64_t i = 0; i < count; ++i) pointers_[i] = value(v[i]);
    return pointers_;
  }
  Scalar combine(int8_t sign, const Scalar* h, const std::vector<Vector>& v, int64_t count, T factor, Vector& w) {
    const auto before = w.version, first = tape_.terms.size();
    plain_.resize(count);
    for (int64_t i = 0; i < count; ++i) {
      plain_[i] = h[i].value;
      if (recording_) tape_.terms.push({v[i].version, h[i].node, sign * h[i].value});
    }
    const auto& from = pointers(v, count);
    const T left2 = vectors_.multi_axpy(T(sign), plain_.data(), from.data(), count, factor, changed(w), tape_.length());
    note({.kind = Kind::kCombination,
          .out = w.version,
          .a = before,
          .factor = factor,
          .sign = sign,
          .first_term = first,
          .count = static_cast<int32_t>(count)});
    return left2;
  }

  kernels::WholeVectors<T> vectors_;
  Tape<T>& tape_;
  SampleSpace<T>& values_;
  bool recording_ = true;
  Vector b_;
  Scalar b2_;
  std::vector<T*> pointers_;
  std::vector<T> plain_;
};

}  // namespace prdp
