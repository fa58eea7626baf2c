#pragma once
#include <memory>
#include <optional>

#include "prdp/operators/operator.h"
#include "prdp/operators/registered_products.h"

namespace prdp {

/// Kind "function"; the shape holds the number of its RegisteredProducts. Derivatives with respect to the tensors come
/// from autograd through `apply`. The exact solve multiplies A with unit vectors, so it is for small n.
class FunctionOperator final : public Operator {
 public:
  explicit FunctionOperator(const OperatorSpec& spec);
  void check_vector(const at::Tensor& b) const override;
  at::Tensor apply(const at::Tensor& v) const override;
  at::Tensor apply_transpose(const at::Tensor& v) const override;
  /// Raises ValueError if it was not given.
  at::Tensor diagonal() const override;
  at::Tensor solve_directly(const at::Tensor& b, bool transposed) const override;
  std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const override;
  /// Not known before an exact solve: 0, or NaN if a tensor is not finite.
  at::Tensor norm() const override;
  at::Tensor norm_of_transpose() const override;
  /// The samples whose product with a vector of ones is not finite, if a tensor is not; all if no product is.
  at::Tensor nonfinite_samples(const at::Tensor& b) const override;
  bool may_be_singular() const override { return static_cast<bool>(registered_->products().apply_transpose); }
  /// Null, because it is not known which tensors have a batch axis.
  std::unique_ptr<Operator> select(const at::Tensor&) const override { return nullptr; }
  /// Not known, so this raises ValueError.
  std::vector<int64_t> vector_shape() const override;

 private:
  /// Whether a transform of torch.func runs, or a tensor belongs to one.
  bool in_transform(const at::Tensor& v) const;
  at::Tensor product(const Products::Product& function, const at::Tensor& v, const std::vector<at::Tensor>& tensors,
                     const char* name) const;
  at::Tensor product_checking_captures(const at::Tensor& v) const;
  at::Tensor derivative_transposed(const at::Tensor& v) const;
  /// A v for autograd to record; raises ValueError where it cannot.
  at::Tensor recorded_product(const at::Tensor& v, const std::vector<at::Tensor>& tensors) const;
  at::Tensor norm_of(bool transposed) const;
  /// Raises ValueError where autograd does not follow `apply`, so that no tensor could have a gradient.
  void check_is_recorded(const at::Tensor& u) const;

  std::shared_ptr<const RegisteredProducts> registered_;
  std::vector<at::Tensor> tensors_;
  /// A product at `point`, recorded once and used for all products with the transpose.
  struct Recorded {
    at::Tensor point, product;
  };
  mutable std::optional<Recorded> recorded_;
  mutable bool looked_in_inference_ = false;  // for writes, which no tensor counts there
  mutable at::Tensor norms_of_matrix_[2];     // (batch,) of A and of Aᵀ, once that has been made
  mutable std::vector<int64_t> vectors_;  // shape of the right-hand side; empty: not known
};

}  // namespace prdp
