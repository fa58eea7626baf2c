#pragma once
#include <cmath>
#include <cstdint>
#include <utility>

#include "prdp/gpu/device/cycle.h"
#include "prdp/gpu/device/setting.h"
#include "prdp/gpu/device/team.h"
#include "prdp/gpu/device/views.h"
#include "prdp/solvers/iterate.h"

namespace prdp::gpu {

/// The vectors of a sample that a team of threads owns, and what is done with them without A: the operations of
/// solvers/space.h. Each is a loop over a thread's share of the entries, and a sum is the same in every thread.
template <class S>
class BlockVectors {
 public:
  using T = typename S::T;
  using A = typename S::A;
  using Vector = T*;
  using Scalar = T;
  using TeamOfSample = Team<S::kBlocks, S::kThreads>;

  /// As many vectors as fit lie in shared memory. `beyond`, in global memory, has the others, then the numbers for
  /// damping (kDampingAt), then the coarse grids (kCyclesAt).
  BlockVectors(TeamOfSample& team, T* in_block, T* beyond) : team_(team), in_block_(in_block), beyond_(beyond) {}
  static constexpr int64_t kDampingAt = static_cast<int64_t>(S::kVectors - S::kInBlock) * A::kUnknowns;
  static constexpr int64_t kCyclesAt = kDampingAt + numbers_beyond(S::kRestart);
  static constexpr int64_t kNumbersBeyond = kCyclesAt + S::Cycles::kBeyond;

  // ---- a sample (solve_sample.h)

  /// y = factor x, where one of the two is no vector of the space.
  PRDP_NOINLINE void load(const T* x, T factor, Vector y) {
    each<1>([&](int i) { return factor * x[i]; }, into(y));
  }
  T store(const T* x, T factor, T* u) {
    load(x, factor, u);
    return largest_magnitude(u);
  }
  /// Of an array that is no vector of the space; only spaces that pad their vectors tell the two apart.
  T largest_given(const T* x) { return largest_magnitude(x); }
  PRDP_NOINLINE T largest_magnitude(const T* x) {
    return largest_over_rows([&](int i) { return std::abs(x[i]); });
  }
  void scale(T factor, Vector x) { load(x, factor, x); }
  PRDP_NOINLINE void axpy(T alpha, const T* x, Vector y) {
    each<1>([&](int i) { return y[i] + alpha * x[i]; }, into(y));
  }

  // ---- primitives

  Vector vector() {
    require(S::Cycles::kVectors + used_ < S::kVectors);
    return vector_at(S::Cycles::kVectors + used_++);
  }
  Vector scratch() { return own(kScratch); }
  static constexpr int64_t unknowns() { return A::kUnknowns; }
  template <class X>
  Slice<X> array(int64_t n) const {
    auto* first = reinterpret_cast<X*>(numbers_ + used_numbers_);
    used_numbers_ += (n * static_cast<int64_t>(sizeof(X)) + 7) / 8 * 8;
    require(used_numbers_ <= S::kBytesOfArrays);
    return {first, n};
  }
  PRDP_NOINLINE void fill_zero(Vector v) {
    each<1>([](int) { return T(0); }, into(v));
  }
  PRDP_NOINLINE void copy(const T* from, Vector to) {
    each([&](int i) { return from[i]; }, into(to));
  }
  void advance(Vector& x, Vector& next) { std::swap(x, next); }
  PRDP_NOINLINE void add(const T* d, Vector x) {
    each<1>([&](int i) { return x[i] + d[i]; }, into(x));
  }
  PRDP_NOINLINE void xpby(const T* x, Scalar beta, Vector y) {
    each([&](int i) { return x[i] + beta * y[i]; }, into(y));
  }
  PRDP_NOINLINE Scalar xpby_with_square(const T* x, Scalar beta, Vector y) {
    return square_of([&](int i) { return x[i] + beta * y[i]; }, y);
  }
  PRDP_NOINLINE Scalar dot(const T* v, const T* w) {
    T s = 0;
    each([&](int i) { return v[i] * w[i]; }, [&](int, T value) { s += value; });
    return team_.sum(s);
  }

  // ---- GMRES

  PRDP_NOINLINE void dots(const Slice<Vector>& v, int64_t count, Scalar factor, const T* w, Scalar* h) {
    for (int64_t j = 0; j < count; j += kMostAtOnce) {
      T s[kMostAtOnce] = {};
      const int some = static_cast<int>(count - j < kMostAtOnce ? count - j : kMostAtOnce);
      const T* of[kMostAtOnce];
      PRDP_UNROLL for (int k = 0; k < kMostAtOnce; ++k) of[k] = v[j + (k < some ? k : 0)];
      each([&](int i) { return factor * w[i]; },
           [&](int i, T value) { PRDP_UNROLL for (int k = 0; k < kMostAtOnce; ++k) s[k] += of[k][i] * value; });
      team_.sum(s);
      for (int k = 0; k < some; ++k) h[j + k] = s[k];
    }
  }
  PRDP_NOINLINE Scalar subtract_combination(const Scalar* h, const Slice<Vector>& v, int64_t count, Scalar factor,
                                            Vector w) {
    return square_of(
        [&](int i) {
          T sum = factor * w[i];
          PRDP_NO_UNROLL for (int j = 0; j < static_cast<int>(count); ++j) sum -= h[j] * v[j][i];
          return sum;
        },
        w);
  }
  PRDP_NOINLINE void add_combination(const Scalar* y, const Slice<Vector>& v, int64_t count, Vector x) {
    each(
        [&](int i) {
          T sum = x[i];
          PRDP_NO_UNROLL for (int j = 0; j < static_cast<int>(count); ++j) sum += y[j] * v[j][i];
          return sum;
        },
        into(x));
  }

 protected:
  /// The vectors that the space itself keeps.
  enum Own : int { kB, kScratch, kStart, kOriginalB };
  static_assert(kOriginalB + 1 == kOwnVectors);
  Vector own(Own which) { return vector_at(S::Cycles::kVectors + which); }
  /// All vectors, those of cycles first, then the space's own and those of the method.
  Vector vector_at(int i) {
    if (i < S::kInBlock) return in_block_ + static_cast<int64_t>(i) * A::kUnknowns;
    return beyond_ + static_cast<int64_t>(i - S::kInBlock) * A::kUnknowns;
  }

  /// f(i), and then store(i, f(i)), for this thread's cells. Loops that run a few times in a solve take one cell at
  /// once, which leaves less to compile.
  template <int kAtOnce = kCellsAtOnce, class F, class Store>
  void each(const F& f, const Store& store) const {
    constexpr int of_block = (A::kUnknowns + S::kBlocks - 1) / S::kBlocks;
    constexpr int rounds = (of_block + S::kThreads - 1) / S::kThreads, passes = (rounds + kAtOnce - 1) / kAtOnce;
    team_.template each<(rounds + passes - 1) / passes>(A::kUnknowns, f, store);
  }
  static auto into(Vector v) {
    return [v](int i, T value) { v[i] = value; };
  }
  /// out = f; returns ‖out‖².
  template <class F>
  T square_of(const F& f, Vector out) {
    T s = 0;
    each(f, [&](int i, T value) {
      out[i] = value;
      s += value * value;
    });
    return team_.sum(s);
  }
  template <class F>
  auto largest_over_rows(const F& f) {
    return largest_of(team_, A::kUnknowns, f);
  }

  TeamOfSample& team_;
  T *in_block_, *beyond_;

 private:
  /// A method takes no more than solve_kernel() made room for.
  static void require(bool has_room) {
    if (!has_room) __trap();
  }

  int used_ = kOwnVectors;
  alignas(8) mutable char numbers_[S::kBytesOfArrays > 0 ? S::kBytesOfArrays : 1];
  mutable int64_t used_numbers_ = 0;
};

}  // namespace prdp::gpu
