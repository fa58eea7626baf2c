#pragma once
#include <utility>

#include "prdp/gpu/device/team.h"

/// The preconditioner of kernels/saddle_point.h by a team of threads: for the Navier-Stokes equations [[C, G], [D, 0]],
/// Jacobi sweeps in the place of C⁻¹, and a V-cycle for the pressure.
namespace prdp::gpu {

template <class S>
struct SaddlePoint {
  using T = typename S::T;
  using A = typename S::A;
  static constexpr int kVelocity = A::kVelocity, kPressure = A::kUnknowns - kVelocity;

  Team<S::kBlocks, S::kThreads>& team;
  const A& a;
  const typename S::Cycles::template Of<S>& cycle;
  T* memory[6];

  /// z = M⁻¹ r. That of Aᵀ is made of Aᵀ, as on the CPU.
  PRDP_NOINLINE void apply(const T* r, T* z) const {
    T *const c = memory[3], *const p = memory[4] + kVelocity;
    team.meet();
    team.for_each(kPressure, [&](int i) { c[kVelocity + i] = r[kVelocity + i]; });
    solve_schur(c + kVelocity, p);
    team.meet();
    const Part pressure{memory[4], /*is_pressure=*/true};
    team.for_each(kVelocity, [&](int i) { c[i] = r[i] - product(pressure, i); });
    const T* const u = solve_velocity(c);
    team.meet();  // each thread has other cells of the whole vector than of its parts
    team.for_each(A::kUnknowns, [&](int i) { z[i] = i < kVelocity ? u[i] : pressure.v[i]; });
  }

 private:
  /// A vector of which one part is zero.
  struct Part {
    const T* v;
    bool is_pressure;
    T operator[](int i) const { return (i >= kVelocity) == is_pressure ? v[i] : T(0); }
  };
  PRDP_NOINLINE T product(const Part& v, int row) const { return a.product(v, row); }

  void solve_schur(const T* r, T* p) const {
    cycle.apply(team, a.laplacian(), r, p, memory[0], memory[1], memory[2]);
    const T of_laplacian = a.of_laplacian(), of_identity = a.of_identity();
    team.for_each(kPressure, [&](int i) { p[i] = of_laplacian * p[i] + of_identity * r[i]; });
  }
  /// Sweeps from zero; returns the vector that holds the result.
  PRDP_NOINLINE const T* solve_velocity(const T* c) const {
    T *x = memory[4], *next = memory[5], *const diagonal = memory[0];
    team.for_each(kVelocity, [&](int i) {
      diagonal[i] = a.diagonal(i);
      x[i] = c[i] / diagonal[i];
    });
    constexpr int64_t sweeps_per_smoothing = 2;
    PRDP_NO_UNROLL for (int64_t s = 1; s < sweeps_per_smoothing * cycle.hierarchy.smoothing; ++s, std::swap(x, next)) {
      team.meet();
      const Part velocity{x, /*is_pressure=*/false};
      team.for_each(kVelocity, [&](int i) { next[i] = x[i] + (c[i] - product(velocity, i)) / diagonal[i]; });
    }
    return x;
  }
};

}  // namespace prdp::gpu
