#pragma once
#include <cstdint>

#include "prdp/kernels/kernel.h"
#include "prdp/solvers/batch_arrays.h"
#include "prdp/solvers/solver.h"

/// The CPU's way through a batch: sample after sample, each to its end.
namespace prdp {

template <class T>
struct SampleBatch {
  const Solver& solver;
  int64_t unknowns;
  BatchArrays<T> arrays;
};

/// A that all samples of a batch share, with what is made of it once.
template <class T>
struct SharedSystem {
  std::shared_ptr<const kernels::Kernel<T>> a;          // null: A is not finite
  std::shared_ptr<const kernels::Factors<T>> factors;  // of a direct method
};
/// Null if the samples have an operator each. For a direct solver, its kernel may outlive the batch.
template <class T>
std::unique_ptr<SharedSystem<T>> shared_system(const kernels::KernelBatch<T>& kernels, const Solver& solver);
/// The same with a kernel that was made before.
template <class T>
std::unique_ptr<SharedSystem<T>> system_of(std::shared_ptr<const kernels::Kernel<T>> kernel, const Solver& solver);

/// Solves the samples [begin, end) on this thread.
template <class T>
void solve_samples(const kernels::KernelBatch<T>& kernels, const SharedSystem<T>* shared, const SampleBatch<T>& batch,
                   int64_t begin, int64_t end);

}  // namespace prdp
