#pragma once
#include <cstdint>
#include <tuple>

#include "prdp/solvers/space.h"

namespace prdp {

/// x ← x + B(b - A x). No products of vectors with each other.
template <class Space, class B>
class CorrectionMethod {
 public:
  static constexpr bool kContracts = true;
  explicit CorrectionMethod(Space& space) : x(space.vector()), space_(space), r_(space.vector()), d_(space.vector()) {}

  void start() {
    space_.fill_zero(x);
    space_.copy(space_.b(), r_);
    residual2_ = space_.b2();
    ready_ = true;
  }
  void step() {
    if (!ready_) space_.residual(x, r_);
    B::apply(space_, r_, d_);
    space_.add(d_, x);
    ready_ = false;
  }
  auto residual2() { return recompute_residual(); }
  auto recompute_residual() {
    if (!ready_) residual2_ = space_.residual(x, r_);
    ready_ = true;
    return residual2_;
  }

  /// What the next iteration starts from; resume() once it has been put back.
  auto iteration_state() { return std::tie(x); }
  void resume(int64_t) { ready_ = false; }

  typename Space::Vector x;

 private:
  Space& space_;
  typename Space::Vector r_, d_;  // residual; its correction
  typename Space::Scalar residual2_{};
  bool ready_ = false;  // r_ and residual2_ belong to x
};

struct VCycle {
  static void apply(auto& space, auto& r, auto& d) { space.apply_cycle(r, d); }
};
template <VectorSpace Space>
struct MultigridMethod : CorrectionMethod<Space, VCycle> {
  using CorrectionMethod<Space, VCycle>::CorrectionMethod;
};

struct ExactSolve {
  static void apply(auto& space, auto& r, auto& d) { space.solve_directly(r, d); }
};
/// The first iteration solves, those after it refine.
template <FactorisedSpace Space>
struct DirectMethod : CorrectionMethod<Space, ExactSolve> {
  using CorrectionMethod<Space, ExactSolve>::CorrectionMethod;
  static constexpr bool kIsExact = true;
};

}  // namespace prdp
