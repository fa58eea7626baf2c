#pragma once
#include <functional>
#include <memory>

#include "prdp/operators/operator.h"

namespace prdp {

/// A user's own operator: its products as functions of a batch of vectors (batch, …) and of the tensors
/// that A is made of. They return the shape and dtype of the vectors, and differ between samples only
/// through the tensors.
struct Products {
  using Product = std::function<at::Tensor(const at::Tensor& v, const std::vector<at::Tensor>& tensors)>;
  Product apply, apply_transpose;
  /// ∂⟨λ, A u⟩ with respect to each tensor where a transform of torch.func runs, which goes without autograd's
  /// C++ interface; empty: there are no such transforms.
  std::function<std::vector<at::Tensor>(const at::Tensor& lambda, const at::Tensor& u,
                                        const std::vector<at::Tensor>& tensors)>
      product_rule{};
};

/// Functions cannot cross torch's dispatcher, a number can: it stands for them as long as this lives.
class RegisteredProducts {
 public:
  static std::shared_ptr<const RegisteredProducts> make(Products products);
  /// Raises ValueError where they no longer live.
  static std::shared_ptr<const RegisteredProducts> find(int64_t number);
  ~RegisteredProducts();

  int64_t number() const { return number_; }
  const Products& products() const { return products_; }
  /// The operator, for linear_solve.
  OperatorSpec spec(std::vector<at::Tensor> tensors) const { return {"function", {number_}, {}, std::move(tensors)}; }

 private:
  explicit RegisteredProducts(Products products) : products_(std::move(products)) {}
  Products products_;
  int64_t number_ = 0;
};

/// Kind "function", shape (number of its products). Derivatives with respect to the tensors come from
/// autograd through apply; the exact solve probes A with unit vectors, for small systems.
class FunctionOperator final : public Operator {
 public:
  explicit FunctionOperator(const OperatorSpec& spec);
  void check_vector(const at::Tensor& b) const override;
  at::Tensor apply(const at::Tensor& v) const override;
  at::Tensor apply_transpose(const at::Tensor& v) const override;
  /// Unknown: ValueError.
  at::Tensor diagonal() const override;
  at::Tensor solve_directly(const at::Tensor& b) const override;
  at::Tensor solve_transpose_directly(const at::Tensor& b) const override;
  std::vector<at::Tensor> product_rule(const at::Tensor& lambda, const at::Tensor& u) const override;
  /// Unknown: 0, or NaN where a tensor is not finite.
  at::Tensor norm() const override;
  /// Unknown which tensors have a batch axis: nothing.
  std::unique_ptr<Operator> select(const at::Tensor&) const override { return nullptr; }
  /// Unknown: ValueError.
  std::vector<int64_t> vector_shape() const override;

 private:
  std::shared_ptr<const RegisteredProducts> registered_;
  std::vector<at::Tensor> tensors_;
};

}  // namespace prdp
