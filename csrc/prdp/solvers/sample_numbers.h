#pragma once
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>

#include "prdp/solvers/sample_state.h"

namespace prdp {

/// Signs without a pattern, the same for every sample: whether number i changes its own.
inline bool is_negated(int64_t i) { return std::sin(static_cast<double>((i + 1) * (i + 1))) < 0.0; }

/// The same for many choices of signs, with which a few unknowns do not agree in all. (splitmix64)
inline constexpr int64_t kSignPatterns = 16;
inline bool is_negated(int64_t i, int64_t pattern) {
  auto bits = static_cast<uint64_t>(i * kSignPatterns + pattern + 1) * 0x9e3779b97f4a7c15;
  bits = (bits ^ (bits >> 30)) * 0xbf58476d1ce4e5b9;
  bits = (bits ^ (bits >> 27)) * 0x94d049bb133111eb;
  return ((bits ^ (bits >> 31)) & 1) != 0;
}

/// The signs of several attempts at an estimate.
inline bool is_negated_in(int64_t attempt, int64_t i) { return attempt == 0 ? is_negated(i) : is_negated(i, attempt); }

/// What the spaces of one sample do with its numbers (space.h): quotients that tell a breakdown from a small number,
/// and numbers that vanish where they are rounding. b and A are scaled to the order of one.
template <class T>
class SampleNumbers {
 public:
  using Scalar = T;
  using States = std::array<SampleState, 1>;

  static constexpr double unit_roundoff() { return std::numeric_limits<T>::epsilon() / 2; }
  void assign(Scalar from, Scalar& to) { to = from; }
  static Scalar sum_of_squares(Scalar v2, Scalar a, Scalar w2) { return v2 + a * a * w2; }

  static Scalar guarded_quotient(Scalar num, Scalar den, Scalar v2, Scalar w2, bool& breaks) {
    if (num < kNegligible) return 0;  // nothing is left to do
    if (!std::isfinite(w2)) return std::numeric_limits<T>::quiet_NaN();
    if (!std::isfinite(v2) && std::isfinite(den) && den != T(0)) return num / den;  // v: a long direction of M⁻¹
    breaks = is_zero_beside(den, v2, w2);
    return breaks ? T(0) : num / den;
  }
  Scalar guarded_quotient(Scalar num, Scalar den, Scalar v2, Scalar w2) {
    bool breaks = false;
    const Scalar quotient = guarded_quotient(num, den, v2, w2, breaks);
    broken_ = broken_ || breaks;
    return quotient;
  }
  static Scalar breaks_down(Scalar den, Scalar v2, Scalar w2, Scalar active) {
    return active != 0 && std::isfinite(v2) && std::isfinite(w2) && is_zero_beside(den, v2, w2);
  }
  static Scalar ratio(Scalar num, Scalar den) { return den < kNegligible ? T(0) : num / den; }
  void break_down_unless_positive(Scalar a, Scalar r2) { broken_ = broken_ || (!(a > 0) && !(r2 < kNegligible)); }
  static Scalar is_rounding(Scalar a, Scalar v2, Scalar w2, double factor) {
    return std::abs(a) < std::sqrt(v2) * std::sqrt(w2) * static_cast<T>(factor);
  }
  static Scalar unless_zero(Scalar a, Scalar b, Scalar active) { return b != 0 && active != 0 ? a : 0; }

  /// What GMRES needs: numbers that may vanish.
  static constexpr int derivatives() { return 0; }
  Scalar constant(Scalar value) const { return value; }
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
  void restore(Scalar where, Scalar from, Scalar& to) const { to = where != 0 ? from : to; }
  Scalar is_zero(Scalar value) const { return value == 0; }
  Scalar is_not_zero(Scalar value) const { return value != 0; }
  bool surely_all(Scalar value) const { return value != 0; }
  bool all_ended(Scalar ended) const { return ended != 0; }

  // ---- what iterate.h asks for
  static std::array<double, 1> values_of(Scalar value) { return {static_cast<double>(value)}; }
  std::array<bool, 1> broken() const { return {broken_}; }
  template <class Predicate>
  void freeze_unless(const States&, const Predicate&) {}  // a lone sample stops by leaving the loop
  template <class Function>
  static auto map(const States& states, const Function& f) {
    return std::array<decltype(f(states[0])), 1>{f(states[0])};
  }
  static T* select(const std::array<bool, 1>&, T*, T* remade) { return remade; }

 protected:
  bool broken_ = false;

 private:
  static bool is_zero_beside(Scalar den, Scalar v2, Scalar w2) {
    return std::abs(den) <= std::numeric_limits<T>::epsilon() * std::sqrt(v2) * std::sqrt(w2);
  }
  /// Squared norms below this are zero to the dtype.
  static constexpr T kNegligible = std::numeric_limits<T>::min() / std::numeric_limits<T>::epsilon();
  static constexpr T kVanishing = 16 * std::numeric_limits<T>::epsilon();
};

}  // namespace prdp
