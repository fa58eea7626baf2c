#pragma once
#include <atomic>
#include <functional>
#include <memory>
#include <optional>

#include "prdp/operators/operator.h"

namespace prdp {

/// A user's own operator: its products as functions of a batch of vectors (batch, …) and of the tensors
/// that A is made of. They return the shape and dtype of the vectors, change neither argument, and differ
/// between samples only through the tensors.
struct Products {
  using Product = std::function<at::Tensor(const at::Tensor& v, const std::vector<at::Tensor>& tensors)>;
  using Diagonal = std::function<at::Tensor(const std::vector<at::Tensor>& tensors)>;
  Product apply;
  Product apply_transpose{};  // torch's own derivative of `apply` where not given
  Diagonal diagonal{};        // broadcastable against the vectors, differentiable; for Jacobi
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
  /// Of the first product below autograd: whether it is to look for captured tensors (see
  /// refuse_captured_gradients).
  enum class Captures { kUnknown, kWanted, kNone };
  mutable std::atomic<Captures> captures{Captures::kUnknown};
  /// The operator, for linear_solve.
  OperatorSpec spec(std::vector<at::Tensor> tensors) const { return {"function", {number_}, {}, std::move(tensors)}; }

 private:
  explicit RegisteredProducts(Products products) : products_(std::move(products)) {}
  Products products_;
  int64_t number_ = 0;
};

/// A product that uses a tensor which requires grad and is not among those handed over would lose its
/// gradient without a word. After this call the operator's next product below autograd raises ValueError in
/// that case; once for each RegisteredProducts, at the cost of recording one product.
void refuse_captured_gradients(const OperatorSpec& a);

/// Kind "function", shape (number of its products). Derivatives with respect to the tensors come from
/// autograd through apply; the exact solve probes A with unit vectors, for small systems.
class FunctionOperator final : public Operator {
 public:
  explicit FunctionOperator(const OperatorSpec& spec);
  void check_vector(const at::Tensor& b) const override;
  at::Tensor apply(const at::Tensor& v) const override;
  at::Tensor apply_transpose(const at::Tensor& v) const override;
  /// ValueError where it is not given.
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
  at::Tensor product(const Products::Product& function, const at::Tensor& v,
                     const std::vector<at::Tensor>& tensors, const char* name) const;
  at::Tensor product_without_captures(const at::Tensor& v) const;
  at::Tensor derivative_transposed(const at::Tensor& v) const;

  std::shared_ptr<const RegisteredProducts> registered_;
  std::vector<at::Tensor> tensors_;
  /// A product at `point`, recorded once for all products with the transpose.
  struct Recorded {
    at::Tensor point, product;
  };
  mutable std::optional<Recorded> recorded_;
  mutable std::vector<int64_t> vectors_;  // shape of the right-hand side; empty: not known
};

}  // namespace prdp
