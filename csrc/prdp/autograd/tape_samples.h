#pragma once
#include <functional>

#include "prdp/autograd/product_rows.h"
#include "prdp/kernels/kernel.h"
#include "prdp/solvers/solver.h"

/// The CPU's way back through the iterations of a batch: sample after sample, each to its start.
namespace prdp {

/// b, the start x0, the cotangent and the results as plain arrays: b, x0, the cotangent, b_bar and diagonal_bar
/// contiguous (batch, unknowns), iterations and applications (batch,). Null for x0: all start from zero.
template <class T>
struct ReverseBatch {
  const Solver& solver;
  int64_t checkpoint_every;
  const int64_t* iterations;
  const T* b;
  const T* x0;
  const T* cotangent;
  T* b_bar;
  T* diagonal_bar;  // the cotangent of the diagonal, where the method divides by it; null: not wanted
  int64_t* applications;
  std::function<ProductRows(int64_t sample)> rows;  // for A's gradient; empty: not wanted
  std::function<void(int64_t sample, std::vector<at::Tensor>)> take_gradients;
};

/// Takes the samples [begin, end) back on this thread; those of no iterations get zeros, and so do those whose A is not
/// finite.
template <class T>
void reverse_samples(const kernels::KernelBatch<T>& a, const kernels::KernelBatch<T>& transpose,
                     const ReverseBatch<T>& batch, int64_t unknowns, int64_t begin, int64_t end);

}  // namespace prdp
