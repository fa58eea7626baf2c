#pragma once
#include <atomic>
#include <functional>
#include <memory>

#include "prdp/operators/operator.h"

namespace prdp {

/// An operator of your own, given by its products: functions of a batch of vectors (batch, …) and of the tensors that
/// A is made of. They return the shape and dtype of the vectors and do not change their arguments. Samples may differ
/// only through the tensors.
struct Products {
  using Product = std::function<at::Tensor(const at::Tensor& v, const std::vector<at::Tensor>& tensors)>;
  using Diagonal = std::function<at::Tensor(const std::vector<at::Tensor>& tensors)>;
  using ProductRule = std::function<std::vector<at::Tensor>(const at::Tensor& lambda, const at::Tensor& u,
                                                            const std::vector<at::Tensor>& tensors)>;
  Product apply;
  Product apply_transpose{};  // if empty, torch's derivative of `apply`
  Diagonal diagonal{};        // broadcastable against the vectors, differentiable; for Jacobi
  /// The derivative of `apply`, and ∂⟨λ, A u⟩ with respect to each tensor, for use inside a transform of torch.func,
  /// which does not work with autograd's C++ interface. Python supplies them; in C++ they stay empty.
  Product transpose_in_transforms{};
  ProductRule product_rule{};
};

/// What is shared by all products that are made of the same code, as those of a step that makes its operator anew.
struct FunctionCode {
  std::atomic<int64_t> solves{0};                 // see refuse_nonlinear_product
  std::atomic<bool> warned_of_product{false};  // see warn_of_another_transpose and warn_of_another_product
};

/// Keeps products alive under a number, because functions cannot pass through torch's dispatcher but numbers can.
class RegisteredProducts {
 public:
  static std::shared_ptr<const RegisteredProducts> make(Products products);
  /// Raises ValueError if they no longer exist.
  static std::shared_ptr<const RegisteredProducts> find(int64_t number);
  ~RegisteredProducts();

  int64_t number() const { return number_; }
  const Products& products() const { return products_; }
  /// Whether the next product below autograd looks for captured tensors (see refuse_captured_gradients).
  mutable std::atomic<bool> looks_for_captures{false};
  std::shared_ptr<FunctionCode> code;
  /// The operator, for linear_solve.
  OperatorSpec spec(std::vector<at::Tensor> tensors) const { return {"function", {number_}, {}, std::move(tensors)}; }

 private:
  explicit RegisteredProducts(Products products) : products_(std::move(products)) {}
  Products products_;
  int64_t number_ = 0;
};

/// Whether the operator is made of RegisteredProducts, whose number is the first entry of its shape.
inline bool is_function(const OperatorSpec& a) { return a.kind.ends_with("function"); }
/// What keeps the products of a Function alive; null for other operators. Nodes of autograd hold it, as their backward
/// pass may come when nobody else does.
std::shared_ptr<const RegisteredProducts> products_of(const OperatorSpec& a);

}  // namespace prdp
