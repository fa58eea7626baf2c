#include "prdp/operators/function_operator.h"

#include <ATen/ExpandUtils.h>
#include <ATen/TensorSubclassLikeUtils.h>
#include <ATen/functorch/BatchedTensorImpl.h>
#include <ATen/functorch/DynamicLayer.h>
#include <torch/csrc/autograd/autograd.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <mutex>
#include <typeindex>
#include <unordered_map>

#include "prdp/error_text.h"
#include "prdp/operators/dense.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"
#include "prdp/operators/with_autograd.h"

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
  TORCH_CHECK_TYPE(result.defined(), "Function: ", name, " must return a tensor, got none");
  TORCH_CHECK_VALUE(result.device() == v.device(), "Function: ", name, " must return a tensor on ", v.device(),
                    ", got one on ", result.device());
  TORCH_CHECK_VALUE(result.sizes() == v.sizes() && result.scalar_type() == v.scalar_type(), "Function: ", name,
                    " must return what it was given, ", v.sizes(), " in ", v.scalar_type(), ", got ", result.sizes(),
                    " in ", result.scalar_type());
  return result;
}

/// How often a tensor was written to; unknown in inference mode.
int64_t writes(const at::Tensor& t) { return t.is_inference() ? 0 : static_cast<int64_t>(t._version()); }

std::vector<at::Tensor> detached(const std::vector<at::Tensor>& tensors) {
  std::vector<at::Tensor> plain;
  for (const auto& t : tensors) plain.push_back(t.detach());
  return plain;
}

/// Whether a tensor may have a gradient, and entries that are not finite. Complex ones are symbols of spectral
/// operators.
bool holds_numbers(const at::Tensor& t) {
  return at::isFloatingType(t.scalar_type()) || at::isComplexType(t.scalar_type());
}

const char* product_name() { return in_language("matvec", "apply"); }
const char* transpose_name() { return in_language("transpose", "apply_transpose"); }

/// Raises ValueError if a product of constants has a derivative, in reverse mode only if that is asked for.
void check_nothing_is_captured(const at::Tensor& result, bool reverse = true) {
  TORCH_CHECK_VALUE(!(reverse && result.requires_grad()) && !has_tangent(result), "Function: ", product_name(),
                    " uses a tensor that requires grad",
                    has_tangent(result) || in_torch_func() ? ", or that forward mode or torch.func follows," : "",
                    " but is not among its tensors, so that no gradient would reach it; hand it over in tensors, or "
                    "detach it");
}

/// A tensor that vmap maps over, for one of the entries; undefined where there is none.
at::Tensor for_one_entry(at::Tensor t) {
  while (const auto* mapped = at::functorch::maybeGetBatchedImpl(t)) {
    if (mapped->value().size(mapped->bdim()) == 0) return {};
    t = mapped->value().select(mapped->bdim(), 0);
  }
  return t;
}

at::Tensor solve(const at::Tensor& matrix, const at::Tensor& b) {
  return solve_dense(matrix, b.flatten(1).unsqueeze(-1)).reshape_as(b);
}

}  // namespace

namespace {

/// One for each lambda in the source; functions that a pointer points to have one each.
std::shared_ptr<FunctionCode> code_of(const Products::Product& apply) {
  static std::mutex mutex;
  static auto* codes = new std::unordered_map<std::type_index, std::shared_ptr<FunctionCode>>;
  if (apply.target<at::Tensor (*)(const at::Tensor&, const std::vector<at::Tensor>&)>())
    return std::make_shared<FunctionCode>();
  const std::lock_guard lock(mutex);
  auto& code = (*codes)[apply.target_type()];
  if (!code) code = std::make_shared<FunctionCode>();
  return code;
}

}  // namespace

std::shared_ptr<const RegisteredProducts> RegisteredProducts::make(Products products) {
  TORCH_CHECK_VALUE(products.apply, "Function: apply, the product with A, must be given");
  const std::shared_ptr<RegisteredProducts> made(new RegisteredProducts(std::move(products)));
  made->code = code_of(made->products_.apply);
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

std::shared_ptr<const RegisteredProducts> products_of(const OperatorSpec& a) {
  return is_function(a) ? RegisteredProducts::find(a.shape.at(0)) : nullptr;
}

void refuse_captured_gradients(const OperatorSpec& a) {
  RegisteredProducts::find(a.shape.at(0))->looks_for_captures = true;
}

void refuse_captured_transforms(const OperatorSpec& a, const at::Tensor& b) {
  if (a.transposed) return;  // of an adjoint solve, whose A was looked at
  auto constant = a;
  for (auto& t : constant.tensors) t = primal(t).detach();
  const auto v = primal(b).detach();
  const bool reverse = at::GradMode::is_enabled();
  check_nothing_is_captured(with_autograd([&] { return make_operator(constant)->apply(v); }), reverse);
}

void refuse_mapped_captures(const OperatorSpec& a, const at::Tensor& b) {
  auto of_one = a;
  for (auto& t : of_one.tensors) t = for_one_entry(primal(t).detach());
  const auto v = for_one_entry(primal(b).detach());
  const auto is_there = [](const at::Tensor& t) { return t.defined(); };
  if (a.transposed || !v.defined() || !std::all_of(of_one.tensors.begin(), of_one.tensors.end(), is_there)) return;
  TORCH_CHECK_VALUE(!at::functorch::maybeGetBatchedImpl(make_operator(of_one)->apply(v)), "Function: ", product_name(),
                    " uses a tensor that vmap maps over, but that is not among its tensors; hand it "
                    "over in tensors");
}

namespace {

double largest(const at::Tensor& v) { return v.nan_to_num(0.0, 0.0, 0.0).abs().max().to(at::kDouble).item<double>(); }

/// Raises ValueError where A (2 v) is not about 2 A v, where v is b, scaled to the order of one as in a solve.
void refuse_powers(const Operator& a, const at::Tensor& b) {
  const auto magnitude = b.abs().flatten(1).amax(1);
  const auto usable = per_sample(magnitude.isfinite() & magnitude.gt(0), b);
  const auto v = at::where(usable, b * per_sample(power_of_two_scale(magnitude), b), at::zeros_like(b));
  const auto once = a.apply(v);
  const double size = largest(once), off = largest(a.apply(2.0 * v) - 2.0 * once);
  // A derivative by differences is not quite linear.
  TORCH_CHECK_VALUE(off <= 0.1 * size || !std::isfinite(off), "Function: ", product_name(), " must be linear, but ",
                    product_name(), "(2 v) and 2 ", product_name(), "(v) differ by ", off,
                    "; in Newton's method it is the derivative, as ",
                    in_language("torch.func.jvp", "forward-mode autograd"), " makes it");
}

}  // namespace

void refuse_nonlinear_product(const OperatorSpec& a, const at::Tensor& b) {
  const auto code = RegisteredProducts::find(a.shape.at(0))->code;
  const bool can_look = b.is_cpu() && b.numel() > 0 && is_plain(b) && all_plain(a.tensors) && !in_torch_func();
  if (!can_look) return;
  const auto solves = static_cast<uint64_t>(code->solves) + 1;
  if (std::has_single_bit(solves)) {
    const at::NoGradGuard no_grad;
    auto constant = a;
    constant.tensors = detached(a.tensors);
    const auto of = make_operator(constant);
    const auto v = b.detach();
    const double at_zero = largest(of->apply(at::zeros_like(v)));
    // Beside b, as products by differences leave rounding.
    const double rounding = 32.0 * std::sqrt(epsilon_of(b)) * largest(v);
    TORCH_CHECK_VALUE(at_zero == 0.0 || at_zero <= rounding || !std::isfinite(rounding), "Function: ", product_name(),
                      " must be linear, but ", product_name(), "(0) holds ±", at_zero,
                      "; constants, such as values on the boundary, belong to b");
    if (solves == 1) refuse_powers(*of, v);
  }
  ++code->solves;
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
                   "Function: expected a vector in float32 or float64, got ", b.scalar_type());
  vectors_ = b.sizes().vec();
}

at::Tensor FunctionOperator::apply(const at::Tensor& v) const {
  if (registered_->looks_for_captures && !at::GradMode::is_enabled()) return product_without_captures(v);
  return product(registered_->products().apply, v, tensors_, product_name());
}

at::Tensor FunctionOperator::apply_transpose(const at::Tensor& v) const {
  const auto& [apply, transpose, diagonal, transpose_in_transforms, rule] = registered_->products();
  if (transpose) return product(transpose, v, tensors_, transpose_name());
  const bool dual = has_tangent(v) || any_tangent(tensors_);
  if (transpose_in_transforms && in_transform(v) && !dual) return transpose_in_transforms(v, tensors_);
  return derivative_transposed(v);
}

bool FunctionOperator::in_transform(const at::Tensor& v) const {
  return at::functorch::maybeCurrentDynamicLayer() || at::isTensorSubclassLike(v) ||
         at::areAnyTensorSubclassLike(tensors_);
}

at::Tensor FunctionOperator::product(const Products::Product& function, const at::Tensor& v,
                                     const std::vector<at::Tensor>& tensors, const char* name) const {
  const auto of_all = [&] {
    auto sum = writes(v);
    for (const auto& t : tensors) sum += writes(t);
    return sum;
  };
  const auto before = of_all();
  const auto result = checked(function(v, tensors), v, name);
  TORCH_CHECK_VALUE(of_all() == before, "Function: ", name,
                    " changes its arguments in place; it must return a new tensor and leave them as they are");
  return result;
}

at::Tensor FunctionOperator::product_without_captures(const at::Tensor& v) const {
  const auto result = with_autograd(
      [&] { return product(registered_->products().apply, v.detach(), detached(tensors_), product_name()); });
  check_nothing_is_captured(result);
  registered_->looks_for_captures = false;
  return result;  // no graph hangs on it
}

at::Tensor FunctionOperator::derivative_transposed(const at::Tensor& v) const {
  // A v is linear in v, so its derivative is the same everywhere: take it at zero.
  const bool create_graph = at::GradMode::is_enabled();
  const auto found = with_autograd([&]() -> at::Tensor {
    auto at_zero = create_graph ? std::nullopt : recorded_;
    if (!at_zero || at_zero->point.sizes() != v.sizes() || at_zero->point.dtype() != v.dtype()) {
      const auto point = at::zeros_like(v).detach().requires_grad_();
      const auto tensors = create_graph ? tensors_ : detached(tensors_);
      at_zero = Recorded{point, product(registered_->products().apply, point, tensors, product_name())};
      if (!create_graph) recorded_ = at_zero;
    }
    if (!at_zero->product.requires_grad()) return {};
    return torch::autograd::grad({at_zero->product}, {at_zero->point}, {create_graph ? v : v.detach()},
                                 /*retain_graph=*/true, create_graph, /*allow_unused=*/true)[0];
  });
  TORCH_CHECK_VALUE(found.defined(), "Function: torch cannot differentiate ", product_name(),
                    " with respect to its vector; make it of "
                    "torch operations, or give ",
                    transpose_name());
  return found;
}

at::Tensor FunctionOperator::diagonal() const {
  const auto& function = registered_->products().diagonal;
  TORCH_CHECK_VALUE(function,
                    "Function: its diagonal, which Jacobi and preconditioner=\"diagonal\" divide by, is not "
                    "known; give diagonal, or take another method");
  const auto found = function(tensors_);
  TORCH_CHECK_TYPE(found.defined() && at::isFloatingType(found.scalar_type()),
                   "Function: diagonal must return a real tensor");
  TORCH_CHECK_VALUE(vectors_.empty() || at::is_expandable_to(found.sizes(), vectors_),
                    "Function: diagonal must return a shape that broadcasts against the vectors, ",
                    at::IntArrayRef(vectors_), ", got ", found.sizes());
  return found;
}

std::vector<int64_t> FunctionOperator::vector_shape() const {
  TORCH_CHECK_VALUE(false, "Function: its matrix has no known size");
}

at::Tensor FunctionOperator::solve_directly(const at::Tensor& b, bool transposed) const {
  const auto product = [&](const at::Tensor& v) { return transposed ? apply_transpose(v) : apply(v); };
  check_dense_fits(b, b.numel() / std::max<int64_t>(b.size(0), 1), b.size(0));
  return solve(matrix_by_columns(product, b), b);
}

std::vector<at::Tensor> FunctionOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  const auto& rule = registered_->products().product_rule;
  if (rule && (in_transform(u) || in_transform(lambda))) return rule(lambda, u, tensors_);
  // Recorded on copies of its own, or, where the derivative is itself to be differentiated, on views:
  // the partial derivative must not follow a tensor's way through u.
  const bool create_graph = at::GradMode::is_enabled();
  return with_autograd([&] {
    std::vector<at::Tensor> arguments, wanted;
    for (const auto& t : tensors_) {
      const bool recorded = create_graph && t.requires_grad();
      arguments.push_back(recorded ? t.view_as(t) : holds_numbers(t) ? t.detach().requires_grad_() : t);
      if (arguments.back().requires_grad()) wanted.push_back(arguments.back());
    }
    std::vector<at::Tensor> gradients(tensors_.size());
    if (wanted.empty()) return gradients;
    const auto made = product(registered_->products().apply, create_graph ? u : u.detach(), arguments, product_name());
    if (!made.requires_grad()) return gradients;
    const auto found = torch::autograd::grad({made}, wanted, {create_graph ? lambda : lambda.detach()}, create_graph,
                                             create_graph, /*allow_unused=*/true);
    for (size_t i = 0, next = 0; i < tensors_.size(); ++i)
      if (arguments[i].requires_grad()) gradients[i] = found[next++];
    return gradients;
  });
}

at::Tensor FunctionOperator::norm() const {
  auto norm = at::scalar_tensor(0.0, at::kDouble);
  for (const auto& t : tensors_)
    if (holds_numbers(t))
      norm = norm.to(t.device())
                 .masked_fill(t.detach().isfinite().all().logical_not(), std::numeric_limits<double>::quiet_NaN());
  return norm;
}

at::Tensor FunctionOperator::nonfinite_samples(const at::Tensor& b) const {
  auto some = at::zeros({}, b.options().dtype(at::kBool));
  bool any_numbers = false;
  for (const auto& t : tensors_) {
    if (!holds_numbers(t)) continue;
    some = some.logical_or(nonfinite(t.detach()).any());
    any_numbers = true;
  }
  // Another device is not looked at: there the product is taken in any case.
  if (!any_numbers || (b.is_cpu() && !some.item<bool>())) return some;
  const auto rows = nonfinite(apply(at::ones_like(b))).flatten(1).any(1);
  return some.logical_and(rows.logical_or(rows.any().logical_not()));
}

}  // namespace prdp
