#include "prdp/operators/function_operator.h"

#include <ATen/ExpandUtils.h>
#include <ATen/TensorSubclassLikeUtils.h>
#include <ATen/functorch/DynamicLayer.h>
#include <c10/core/AutogradState.h>
#include <c10/core/InferenceMode.h>
#include <torch/csrc/autograd/autograd.h>

#include <algorithm>
#include <limits>
#include <string_view>
#include <utility>

#include "prdp/error_text.h"
#include "prdp/operators/dense.h"
#include "prdp/operators/function_checks.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/tensors.h"
#include "prdp/operators/with_autograd.h"

namespace prdp {

namespace {

at::Tensor checked(const at::Tensor& result, const at::Tensor& v, const char* name) {
  TORCH_CHECK_TYPE(result.defined(), "Function: ", name, " must return a tensor, got none");
  TORCH_CHECK_VALUE(result.device() == v.device(), "Function: ", name, " must return a tensor on ", v.device(),
                    ", got one on ", result.device());
  TORCH_CHECK_VALUE(result.sizes() == v.sizes() && result.scalar_type() == v.scalar_type(), "Function: ", name,
                    " must return what it was given, ", v.sizes(), " in ", dtype_name(v.scalar_type()), ", got ",
                    result.sizes(), " in ", dtype_name(result.scalar_type()));
  return result;
}

/// While it exists, the dispatch state of this thread is that of the user's code, not of the op that we are inside:
/// nothing is recorded unless the product itself asks for it, and writes into tensors are counted. What the product
/// changes beside that, such as a mode that it enters, stays.
class AsOutside {
 public:
  AsOutside() {
    auto keys = c10::impl::tls_local_dispatch_key_set();
    keys.excluded_ = keys.excluded_ - lifted_;
    c10::impl::_force_tls_local_dispatch_key_set(keys);
    if (is_below_autograd()) set_modes(/*reverse=*/false, /*forward=*/true);
  }
  ~AsOutside() {
    auto keys = c10::impl::tls_local_dispatch_key_set();
    keys.excluded_ = keys.excluded_ | lifted_;
    c10::impl::_force_tls_local_dispatch_key_set(keys);
    if (is_below_autograd()) set_modes(was_recording_, had_forward_mode_);
  }
  AsOutside(const AsOutside&) = delete;
  AsOutside& operator=(const AsOutside&) = delete;

 private:
  bool is_below_autograd() const { return lifted_.has(c10::DispatchKey::AutogradFunctionality); }
  static void set_modes(bool reverse, bool forward) {
    c10::AutogradState::get_tls_state().set_grad_mode(reverse);
    c10::AutogradState::get_tls_state().set_fw_grad_mode(forward);
  }
  /// What is excluded now, but for what a user may have switched off.
  static c10::DispatchKeySet excluded_by_operations() {
    auto keys = c10::impl::tls_local_dispatch_key_set().excluded_ - c10::default_excluded_set -
                c10::DispatchKeySet({c10::DispatchKey::Python, c10::DispatchKey::PythonTLSSnapshot});
    return c10::InferenceMode::is_enabled() ? keys - c10::autograd_dispatch_keyset : keys;
  }

  const c10::DispatchKeySet lifted_ = excluded_by_operations();
  const bool was_recording_ = c10::AutogradState::get_tls_state().get_grad_mode();
  const bool had_forward_mode_ = c10::AutogradState::get_tls_state().get_fw_grad_mode();
};

/// How often a tensor was written to; unknown in inference mode.
int64_t writes(const at::Tensor& t) { return t.is_inference() ? 0 : static_cast<int64_t>(t._version()); }

/// The arguments of a product, which it must leave as they are.
class UnchangedArguments {
 public:
  UnchangedArguments(const at::Tensor& v, const std::vector<at::Tensor>& tensors, bool compares_numbers)
      : v_(v), tensors_(tensors), before_(all_writes()), copy_(compares_numbers ? v.clone() : at::Tensor()) {}
  void check_unchanged(const char* name) const {
    const bool is_unchanged =
        all_writes() == before_ && (!copy_.defined() || at::allclose(v_, copy_, 0.0, 0.0, /*equal_nan=*/true));
    TORCH_CHECK_VALUE(is_unchanged, "Function: ", name,
                      " changes its arguments in place; it must return a new tensor and leave them as they are");
  }

 private:
  int64_t all_writes() const {
    int64_t sum = writes(v_);
    for (const auto& t : tensors_) sum += writes(t);
    return sum;
  }
  const at::Tensor& v_;
  const std::vector<at::Tensor>& tensors_;
  int64_t before_;
  at::Tensor copy_;  // of v in inference mode, where nobody counts what is written
};

/// Whether a tensor may have a gradient, and entries that are not finite. Complex ones are symbols of spectral
/// operators.
bool holds_numbers(const at::Tensor& t) {
  return at::isFloatingType(t.scalar_type()) || at::isComplexType(t.scalar_type());
}

const char* transpose_name() { return in_language("transpose", "apply_transpose"); }

[[noreturn]] void refuse_derivative() {
  TORCH_CHECK_VALUE(false, "Function: torch cannot differentiate ", product_name(),
                    " with respect to its vector; make it of torch operations, or give ", transpose_name(),
                    in_language(", or symmetric=True", ""));
}

at::Tensor solve_with(const at::Tensor& matrix, const at::Tensor& b) {
  return solve_dense(matrix, b.flatten(1).unsqueeze(-1)).reshape_as(b);
}

}  // namespace

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
                   "Function: expected a vector in float32 or float64, got ", dtype_name(b.scalar_type()));
  vectors_ = b.sizes().vec();
}

at::Tensor FunctionOperator::apply(const at::Tensor& v) const {
  if (registered_->looks_for_captures && !at::GradMode::is_enabled()) return product_checking_captures(v);
  const auto result = product(registered_->products().apply, v, tensors_, product_name());
  // A derivative that the product takes itself leaves its graph on it.
  const bool has_graph = !at::GradMode::is_enabled() && result.requires_grad() && !has_tangent(result);
  return has_graph ? result.detach() : result;
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
  const bool is_first = v.is_inference() && v.is_cpu() && is_plain(v) && !std::exchange(looked_in_inference_, true);
  const UnchangedArguments arguments(v, tensors, /*compares_numbers=*/is_first);
  const auto call = [&] {
    if (in_torch_func()) return function(v, tensors);
    const AsOutside as_outside;
    return function(v, tensors);
  };
  const auto result = checked(call(), v, name);
  arguments.check_unchanged(name);
  return result;
}

at::Tensor FunctionOperator::product_checking_captures(const at::Tensor& v) const {
  const auto result = product_without_captures([&] {
    return with_autograd(
        [&] { return product(registered_->products().apply, v.detach(), detached(tensors_), product_name()); });
  });
  registered_->looks_for_captures = false;
  return result;
}

at::Tensor FunctionOperator::recorded_product(const at::Tensor& v, const std::vector<at::Tensor>& tensors) const {
  try {
    return product(registered_->products().apply, v, tensors, product_name());
  } catch (const std::exception& error) {
    const std::string_view text(error.what());
    if (text.find("numpy() on Tensor that requires grad") != std::string_view::npos) refuse_derivative();
    if (text.find("Inference tensors cannot be saved") == std::string_view::npos) throw;
  }
  TORCH_CHECK_VALUE(false, "Function: ", product_name(),
                    " uses a tensor that was made in inference mode, which autograd ",
                    "does not record; hand it over in tensors, or give ", transpose_name());
}

at::Tensor FunctionOperator::derivative_transposed(const at::Tensor& v) const {
  // A v is linear in v, so its derivative is the same everywhere: take it at zero.
  const bool create_graph = at::GradMode::is_enabled();
  const auto found = with_autograd([&]() -> at::Tensor {
    auto at_zero = create_graph ? std::nullopt : recorded_;
    if (!at_zero || at_zero->point.sizes() != v.sizes() || at_zero->point.dtype() != v.dtype()) {
      const auto point = at::zeros_like(v).detach().requires_grad_();
      at_zero = Recorded{point, recorded_product(point, create_graph ? recordable(tensors_) : detached(tensors_))};
      if (!create_graph) recorded_ = at_zero;
    }
    if (!at_zero->product.requires_grad()) return {};
    return torch::autograd::grad({at_zero->product}, {at_zero->point}, {create_graph ? v : v.detach()},
                                 /*retain_graph=*/true, create_graph, /*allow_unused=*/true)[0];
  });
  if (!found.defined()) refuse_derivative();
  return found;
}

at::Tensor FunctionOperator::diagonal() const {
  const auto& function = registered_->products().diagonal;
  TORCH_CHECK_VALUE(function, "Function: its diagonal, which Jacobi and ",
                    in_language("preconditioner=\"diagonal\"", "Preconditioner::diagonal()"),
                    " divide by, is not known; give diagonal, or take another method");
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
  const auto matrix = matrix_by_columns(product, b);
  norms_of_matrix_[transposed] = matrix.detach().abs().sum(-1).amax(-1).to(at::kDouble);
  return solve_with(matrix, b);
}

std::vector<at::Tensor> FunctionOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  const auto& rule = registered_->products().product_rule;
  if (rule && (in_transform(u) || in_transform(lambda))) return rule(lambda, u, tensors_);
  // Recorded on copies of its own, or, where the derivative is itself to be differentiated, on views:
  // the partial derivative must not follow a tensor's way through u.
  const bool create_graph = at::GradMode::is_enabled();
  return with_autograd([&] {
    std::vector<at::Tensor> arguments;
    std::vector<int64_t> wanted;
    for (const auto& t : tensors_) {
      const bool recorded = create_graph && t.requires_grad();
      arguments.push_back(recorded ? t.view_as(t) : holds_numbers(t) ? detached(t).requires_grad_() : t);
      wanted.push_back(arguments.back().requires_grad());
    }
    if (std::find(wanted.begin(), wanted.end(), 1) == wanted.end()) return std::vector<at::Tensor>(tensors_.size());
    const auto made = product(registered_->products().apply, create_graph ? u : detached(u), arguments, product_name());
    if (!made.requires_grad()) check_is_recorded(u);
    return gradients_of({made}, {create_graph ? lambda : lambda.detach()}, arguments, wanted, create_graph);
  });
}

void FunctionOperator::check_is_recorded(const at::Tensor& u) const {
  const auto v = detached(u).requires_grad_();
  TORCH_CHECK_VALUE(product(registered_->products().apply, v, detached(tensors_), product_name()).requires_grad(),
                    "Function: torch does not record ", product_name(),
                    ", so that its tensors would get no gradient; make it of torch operations, without ",
                    in_language("numpy and torch.no_grad()", "NoGradGuard"), ", or detach its tensors");
}

at::Tensor FunctionOperator::norm() const { return norm_of(/*transposed=*/false); }

at::Tensor FunctionOperator::norm_of_transpose() const { return norm_of(/*transposed=*/true); }

at::Tensor FunctionOperator::norm_of(bool transposed) const {
  if (norms_of_matrix_[transposed].defined()) return norms_of_matrix_[transposed];
  auto norm = at::scalar_tensor(0.0, at::kDouble);
  for (const auto& t : tensors_)
    if (holds_numbers(t))
      norm = norm.to(t.device())
                 .masked_fill(t.detach().isfinite().all().logical_not(), std::numeric_limits<double>::quiet_NaN());
  return norm;
}

/// Where a tensor is not finite: the samples whose product with ones is not, or all samples if no product is.
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
