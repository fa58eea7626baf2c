#pragma once
#include "prdp/solvers/solve.h"
#include "prdp/solvers/tensor_start.h"

/// A batch of systems before its first iteration, in plain tensor operations.
namespace prdp {

struct PreparedBatch {
  at::Tensor status;        // (batch,): MAX_ITER of the samples that are not settled yet
  at::Tensor takes_part;    // (batch,): those
  at::Tensor inconsistent;  // (batch,): those of them whose b lies outside the range of A, beyond rtol
  at::Tensor rhs, scale;    // b, scaled and within the range of A; its scale, (batch, 1, …)
  at::Tensor rounding;      // (batch,): subnormal_rounding() in the scaled b
  TensorStart start;
};

PreparedBatch prepare_batch(const Operator& a, const at::Tensor& b, const SolveRequest& request);

/// max |b| of each sample, (batch,).
at::Tensor largest_magnitude(const at::Tensor& b);
/// subnormal_rounding() of vectors like b that were multiplied by `scale`, (batch,).
at::Tensor subnormal_rounding(const at::Tensor& scale, const at::Tensor& b);

}  // namespace prdp
