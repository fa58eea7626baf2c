#pragma once
#include <cstdint>

#include "prdp/kernels/kernel.h"
#include "prdp/solvers/solver.h"

/// The CPU's way through a batch: sample after sample, each to its end.
namespace prdp {

/// Right-hand sides and results as plain arrays: b, x0 and u contiguous (batch, unknowns), the others
/// (batch,). `caps` gives each sample its own max_iter; null: all have that of the solver. Null for x0: all start from
/// zero.
template <class T>
struct SampleBatch {
  const Solver& solver;
  int64_t max_iter, unknowns;
  const int64_t* caps;
  bool guarded;
  const T* b;
  const T* x0;
  T* u;
  int64_t* iterations;
  T* residual;
  int64_t* status;
  int64_t* applications;
  T* floor;
};

/// A that all samples of a batch share, with what is made of it once. Without a kernel A is not finite.
template <class T>
struct SharedSystem {
  std::shared_ptr<const kernels::Kernel<T>> a;
  std::shared_ptr<const kernels::Factors<T>> factors;  // of a direct method
};
/// Null if the samples have an operator each.
template <class T>
std::unique_ptr<SharedSystem<T>> shared_system(const kernels::KernelBatch<T>& kernels, const Solver& solver);
/// Of a kernel that was kept. In what shared_system() makes for a direct solver, the kernel may be kept.
template <class T>
std::unique_ptr<SharedSystem<T>> system_of(std::shared_ptr<const kernels::Kernel<T>> kernel, const Solver& solver);

/// Solves the samples [begin, end) on this thread.
template <class T>
void solve_samples(const kernels::KernelBatch<T>& kernels, const SharedSystem<T>* shared, const SampleBatch<T>& batch,
                   int64_t begin, int64_t end);

}  // namespace prdp
