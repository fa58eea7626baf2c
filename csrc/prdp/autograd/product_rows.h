#pragma once
#include <memory>

#include "prdp/operators/operator.h"

namespace prdp {

/// Gathers pairs (λ, v) of one sample and adds up ∂⟨λ, A v⟩/∂g by the operator's product rule, so many
/// at once whatever else happens: the sum does not depend on how the pairs come about.
class ProductRows {
 public:
  /// `a` is the operator of the sample, vectors are of the kind of `like`, a batch of them.
  ProductRows(std::unique_ptr<Operator> a, const at::Tensor& like);

  /// Where the next pair is to be written, contiguous; push() takes it.
  template <class T>
  T* lambda() const { return lambda_.select(0, count_).template mutable_data_ptr<T>(); }
  template <class T>
  T* v() const { return v_.select(0, count_).template mutable_data_ptr<T>(); }
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
