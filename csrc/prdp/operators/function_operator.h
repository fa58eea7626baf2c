#pragma once
#include <atomic>
#include <functional>
#include <memory>
#include <optional>

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
  std::atomic<int64_t> solves{0};  // see refuse_nonlinear_product
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

/// A product that captures a tensor which requires grad, instead of getting it as an argument, would silently lose its
/// gradient. After this call, the operator's next product below autograd raises ValueError in that case, at the cost of
/// recording it. Each differentiable solve asks anew: a parameter may have been frozen before.
void refuse_captured_gradients(const OperatorSpec& a);
/// The same of what a transform of torch.func follows at its level, where b is: by a product that is not used.
/// refuse_mapped_captures() looks for what vmap maps over alone.
void refuse_captured_transforms(const OperatorSpec& a, const at::Tensor& b);
void refuse_mapped_captures(const OperatorSpec& a, const at::Tensor& b);
/// Raises ValueError where a solver would solve another problem than was meant: in the first solve on the CPU with this
/// code, where A (2 v) is not about 2 A v; in the 1st, 2nd, 4th, 8th, …, as what a function captures may change, where
/// A 0 is no rounding beside b.
void refuse_nonlinear_product(const OperatorSpec& a, const at::Tensor& b);

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
  /// Not known: 0, or NaN if a tensor is not finite.
  at::Tensor norm() const override;
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
  at::Tensor product_without_captures(const at::Tensor& v) const;
  at::Tensor derivative_transposed(const at::Tensor& v) const;

  std::shared_ptr<const RegisteredProducts> registered_;
  std::vector<at::Tensor> tensors_;
  /// A product at `point`, recorded once and used for all products with the transpose.
  struct Recorded {
    at::Tensor point, product;
  };
  mutable std::optional<Recorded> recorded_;
  mutable std::vector<int64_t> vectors_;  // shape of the right-hand side; empty: not known
};

}  // namespace prdp
