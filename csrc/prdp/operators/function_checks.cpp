#include "prdp/operators/function_checks.h"

#include <ATen/functorch/BatchedTensorImpl.h>

#include <algorithm>
#include <bit>
#include <cmath>

#include "prdp/error_text.h"
#include "prdp/operators/graph_leaves.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/plain_tensors.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/tensors.h"
#include "prdp/operators/with_autograd.h"

namespace prdp {

namespace {

/// A tensor that vmap maps over, for one of the entries; undefined where there is none.
at::Tensor for_one_entry(at::Tensor t) {
  while (const auto* mapped = at::functorch::maybeGetBatchedImpl(t)) {
    if (mapped->value().size(mapped->bdim()) == 0) return {};
    t = mapped->value().select(mapped->bdim(), 0);
  }
  return t;
}

double largest(const at::Tensor& v) { return v.nan_to_num(0.0, 0.0, 0.0).abs().max().to(at::kDouble).item<double>(); }

/// Raises ValueError where A (-2 v) is not about -2 A v, where v is b, scaled to the order of one as in a solve.
void check_multiples(const Operator& a, const at::Tensor& b) {
  const auto v = scale_finite_samples(b, b.abs().flatten(1).amax(1)).v;
  const auto once = a.apply(v);
  const double size = largest(once), off = largest(a.apply(-2.0 * v) + 2.0 * once);
  // A derivative by differences is not quite linear.
  TORCH_CHECK_VALUE(off <= 0.1 * size || !std::isfinite(off), "Function: ", product_name(), " must be linear, but ",
                    product_name(), "(-2 v) and -2 ", product_name(), "(v) differ by ", off,
                    "; in Newton's method it is the derivative, as ",
                    in_language("torch.func.jvp", "forward-mode autograd"), " makes it");
}

/// Raises ValueError if flipping the sign of v in one sample changes A v in another. Allowed are the error of a product
/// by finite differences, whose step may depend on the whole batch, and the difference between two equal calls.
void check_samples_are_apart(const Operator& a, const at::Tensor& b) {
  if (b.size(0) < 2) return;
  const auto v = scale_finite_samples(b, b.abs().flatten(1).amax(1)).v;
  const auto sizes = v.flatten(1).abs().amax(1).nan_to_num(0.0, 0.0, 0.0);
  const auto turned = sizes.argmax().item<int64_t>();
  auto other = v.clone();
  other.select(0, turned).neg_();
  const auto product = [&](const at::Tensor& of) { return a.apply(of).flatten(1).nan_to_num(0.0, 0.0, 0.0); };
  const auto before = product(v);
  auto change = (product(other) - before).abs().amax(1);
  change[turned] = 0.0;
  const double by_differences = 1e-3 * largest(before);
  if (largest(change) <= by_differences) return;
  const auto changed = change.gt(std::max(by_differences, 4.0 * largest(product(v) - before))).nonzero();
  TORCH_CHECK_VALUE(changed.numel() == 0, "Function: ", product_name(), " must keep samples apart, but ",
                    product_name(), "(v) of sample ", changed[0].item<int64_t>(), " depends on the v of sample ",
                    turned);
}

}  // namespace

const char* product_name() { return in_language("matvec", "apply"); }

at::Tensor product_without_captures(const std::function<at::Tensor()>& product, bool reverse) {
  const auto result = product();
  const auto is_captured = [&] {
    if (!reverse || !result.requires_grad()) return false;
    // A leaf that the product makes, to take a derivative by it, is another one in each call.
    const auto again = product();
    const auto leaves = leaves_of(result), others = leaves_of(again);
    return std::any_of(leaves.begin(), leaves.end(), [&](const auto* leaf) { return others.contains(leaf); });
  };
  TORCH_CHECK_VALUE(!has_tangent(result) && !is_captured(), "Function: ", product_name(),
                    " uses a tensor that requires grad",
                    has_tangent(result) || in_torch_func() ? ", or that forward mode or torch.func follows," : "",
                    " but is not among its tensors, so that no gradient would reach it; hand it over in tensors, or "
                    "detach it");
  return result.detach();
}

void refuse_captured_gradients(const OperatorSpec& a) { products_of(a)->looks_for_captures = true; }

void refuse_captured_transforms(const OperatorSpec& a, const at::Tensor& b) {
  if (a.transposed) return;  // of an adjoint solve, whose A was looked at
  auto constant = a;
  for (auto& t : constant.tensors) t = primal(t).detach();
  const auto v = primal(b).detach();
  const bool reverse = at::GradMode::is_enabled();
  product_without_captures([&] { return with_autograd([&] { return make_operator(constant)->apply(v); }); }, reverse);
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

bool refuse_nonlinear_product(const OperatorSpec& a, const at::Tensor& b) {
  const auto code = products_of(a)->code;
  const bool can_look = b.is_cpu() && b.numel() > 0 && is_plain(b) && all_plain(a.tensors) && !in_torch_func();
  if (!can_look) return false;
  const auto solves = static_cast<uint64_t>(code->solves) + 1;
  const bool looks = std::has_single_bit(solves);
  if (looks) {
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
    if (solves == 1) check_multiples(*of, v);
    check_samples_are_apart(*of, v);
  }
  ++code->solves;
  return looks;
}

}  // namespace prdp
