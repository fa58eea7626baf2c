#include "prdp/operators/function_operator.h"

#include <torch/csrc/autograd/autograd.h>

#include <algorithm>
#include <limits>
#include <mutex>
#include <unordered_map>

#include "prdp/operators/dense.h"

namespace prdp {

namespace {

struct Registry {
  std::mutex mutex;
  std::unordered_map<int64_t, std::weak_ptr<const RegisteredProducts>> entries;
  int64_t last = 0;
};

Registry& registry() {
  static auto* all = new Registry;  // outlives every backward thread
  return *all;
}

at::Tensor checked(const at::Tensor& result, const at::Tensor& v, const char* name) {
  TORCH_CHECK_VALUE(result.sizes() == v.sizes() && result.scalar_type() == v.scalar_type(), "Function: ", name,
                    " must return what it was given, ", v.sizes(), " in ", v.scalar_type(), ", got ",
                    result.sizes(), " in ", result.scalar_type());
  return result;
}

/// The matrix of a product, (batch, n, n), one unit vector at a time.
template <class Product>
at::Tensor probe(const Product& product, const at::Tensor& like) {
  const auto batch = like.size(0), n = like.numel() / std::max<int64_t>(batch, 1);
  std::vector<at::Tensor> columns;
  for (int64_t j = 0; j < n; ++j) {
    auto unit = at::zeros({batch, n}, like.options());
    unit.select(1, j).fill_(1.0);
    columns.push_back(product(unit.view(like.sizes())).reshape({batch, n}));
  }
  return at::stack(columns, -1);
}

at::Tensor solve(const at::Tensor& matrix, const at::Tensor& b) {
  return solve_dense(matrix, b.flatten(1).unsqueeze(-1)).reshape_as(b);
}

}  // namespace

std::shared_ptr<const RegisteredProducts> RegisteredProducts::make(Products products) {
  const std::shared_ptr<RegisteredProducts> made(new RegisteredProducts(std::move(products)));
  const std::lock_guard lock(registry().mutex);
  made->number_ = ++registry().last;
  registry().entries[made->number_] = made;
  return made;
}

std::shared_ptr<const RegisteredProducts> RegisteredProducts::find(int64_t number) {
  std::shared_ptr<const RegisteredProducts> found;
  {
    const std::lock_guard lock(registry().mutex);
    const auto entry = registry().entries.find(number);
    if (entry != registry().entries.end()) found = entry->second.lock();
  }
  TORCH_CHECK_VALUE(found, "Function: the operator no longer exists");
  return found;
}

RegisteredProducts::~RegisteredProducts() {
  const std::lock_guard lock(registry().mutex);
  registry().entries.erase(number_);
}

FunctionOperator::FunctionOperator(const OperatorSpec& spec) : tensors_(spec.tensors) {
  TORCH_CHECK_VALUE(spec.shape.size() == 1 && spec.parameters.empty(),
                    "Function: takes the number of its products and no parameters");
  registered_ = RegisteredProducts::find(spec.shape[0]);
}

void FunctionOperator::check_vector(const at::Tensor& b) const {
  TORCH_CHECK_VALUE(b.dim() >= 2, "Function: expected (batch, ...), got ", b.sizes());
  const auto extents = b.sizes().slice(1);
  TORCH_CHECK_VALUE(std::find(extents.begin(), extents.end(), 0) == extents.end(),
                    "Function: every extent of a vector must be >= 1, got ", b.sizes());
  TORCH_CHECK_TYPE(b.scalar_type() == at::kFloat || b.scalar_type() == at::kDouble,
                   "Function: expected float32 or float64, got ", b.scalar_type());
}

at::Tensor FunctionOperator::apply(const at::Tensor& v) const {
  return checked(registered_->products().apply(v, tensors_), v, "matvec");
}

at::Tensor FunctionOperator::apply_transpose(const at::Tensor& v) const {
  return checked(registered_->products().apply_transpose(v, tensors_), v, "transpose");
}

at::Tensor FunctionOperator::diagonal() const {
  TORCH_CHECK_VALUE(false, "Function: its diagonal, which Jacobi divides by, is not known; take another method");
}

std::vector<int64_t> FunctionOperator::vector_shape() const {
  TORCH_CHECK_VALUE(false, "Function: its matrix has no known size");
}

at::Tensor FunctionOperator::solve_directly(const at::Tensor& b) const {
  return solve(probe([this](const at::Tensor& v) { return apply(v); }, b), b);
}

at::Tensor FunctionOperator::solve_transpose_directly(const at::Tensor& b) const {
  return solve(probe([this](const at::Tensor& v) { return apply_transpose(v); }, b), b);
}

std::vector<at::Tensor> FunctionOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  // Recorded on copies of its own, or, where the derivative is itself to be differentiated, on views:
  // the partial derivative must not follow a tensor's way through u.
  const bool create_graph = at::GradMode::is_enabled();
  const at::AutoGradMode record(true);
  std::vector<at::Tensor> arguments, wanted;
  for (const auto& t : tensors_) {
    const bool real = at::isFloatingType(t.scalar_type());
    arguments.push_back(create_graph ? t.view_as(t) : real ? t.detach().requires_grad_() : t);
    if (arguments.back().requires_grad()) wanted.push_back(arguments.back());
  }
  std::vector<at::Tensor> gradients(tensors_.size());
  if (wanted.empty()) return gradients;
  const auto product = checked(registered_->products().apply(create_graph ? u : u.detach(), arguments), u, "matvec");
  if (!product.requires_grad()) return gradients;
  const auto found = torch::autograd::grad({product}, wanted, {create_graph ? lambda : lambda.detach()},
                                           create_graph, create_graph, /*allow_unused=*/true);
  for (size_t i = 0, next = 0; i < tensors_.size(); ++i)
    if (arguments[i].requires_grad()) gradients[i] = found[next++];
  return gradients;
}

at::Tensor FunctionOperator::norm() const {
  for (const auto& t : tensors_)
    if (at::isFloatingType(t.scalar_type()) && !t.detach().isfinite().all().item<bool>())
      return at::scalar_tensor(std::numeric_limits<double>::quiet_NaN(), at::kDouble);
  return at::scalar_tensor(0.0, at::kDouble);
}

}  // namespace prdp
