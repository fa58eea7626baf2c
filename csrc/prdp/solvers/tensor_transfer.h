#pragma once
#include "prdp/solvers/tensor_stencil.h"

namespace prdp {

/// One axis with every second point dropped, in plain tensor operations: from coarse points to fine ones and back, and
/// the coarse operator. On a ring the coarse points are 0, 2, …, else 1, 3, …
class TensorTransfer {
 public:
  TensorTransfer(const TensorStencil& a, const TensorStencil& transpose, int64_t axis);

  /// P v, or Rᵀ v, for v (batch, channel, *shape).
  at::Tensor interpolate(const at::Tensor& coarse, bool transposed) const;
  /// R v, or Pᵀ v
  at::Tensor restrict(const at::Tensor& fine, bool transposed) const;
  /// R A P. No product is taken: it is put together from the coefficients.
  TensorStencil coarse_operator(const TensorStencil& a) const;
  /// The points of a field (…, *shape) that are coarse.
  at::Tensor at_coarse(const at::Tensor& fine) const { return fine.slice(axis_, periodic_ ? 0 : 1, fine_, 2); }

 private:
  /// The weights of the points between, for the coarse point before and for the one after: (batch or 1, …).
  struct Weights {
    at::Tensor before, after;
  };
  /// Of a number per point between, that of the point after each coarse one, and before it. A coarse point that is
  /// followed by a coarse one, as the last of an odd ring is, gets `without`.
  at::Tensor after_coarse(const at::Tensor& between, double without = 0.0) const;
  at::Tensor before_coarse(const at::Tensor& between, double without = 0.0) const;
  at::Tensor at_between(const at::Tensor& fine) const { return fine.slice(axis_, periodic_ ? 1 : 0, fine_, 2); }

  int64_t axis_, fine_, coarse_, between_;  // the axis from the end; points along it
  bool periodic_;
  at::Tensor order_;  // of the coarse points and those between, as they lie on the fine axis
  Weights interpolation_, restriction_;
};

}  // namespace prdp
