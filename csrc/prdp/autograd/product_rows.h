#pragma once
#include <memory>

#include "prdp/operators/operator.h"

namespace prdp {

/// Collects pairs (λ, v) of one sample, and sums ∂⟨λ, A v⟩/∂g over them by the operator's product rule. It always sums
/// the same number of pairs at once, so the sum does not depend on how the pairs were computed.
class ProductRows {
 public:
  /// `a` is the operator of the sample. Vectors have the shape and dtype of `like`, a batch of them.
  ProductRows(std::unique_ptr<Operator> a, const at::Tensor& like);

  /// Contiguous memory for the next pair. Call push() after writing it.
  template <class T>
  T* lambda() const {
    return lambda_.template mutable_data_ptr<T>() + count_ * lambda_.stride(0);
  }
  template <class T>
  T* v() const {
    return v_.template mutable_data_ptr<T>() + count_ * v_.stride(0);
  }
  void push();
  /// One per tensor of A; undefined where there is no derivative.
  std::vector<at::Tensor> finish();

 private:
  void flush();

  std::unique_ptr<Operator> a_;
  at::Tensor lambda_, v_;
  int64_t count_ = 0;
  std::vector<at::Tensor> sums_;
};

}  // namespace prdp
