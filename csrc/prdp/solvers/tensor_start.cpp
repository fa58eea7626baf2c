#include "prdp/solvers/tensor_start.h"

#include <ATen/TensorSubclassLikeUtils.h>

#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/tensors.h"
#include "prdp/solvers/methods.h"
#include "prdp/solvers/prepared_batch.h"
#include "prdp/solvers/verdicts.h"

namespace prdp {

bool takes_start(Method method, const at::Tensor& x0) { return x0.defined() && !traits(method).is_direct; }

TensorStart make_start(const Operator& a, const at::Tensor& b, const at::Tensor& x0) {
  // The direction z: x0, scaled, without its part in the null space. It takes a product unless that leaves nothing.
  const auto of_order_one = [](const at::Tensor& v) { return scale_finite_samples(v, largest_magnitude(v)); };
  const auto y = of_order_one(x0.detach()).v;
  auto takes_product = per_sample(y.flatten(1).ne(0).any(1), b);
  auto z = a.project_solution(y);
  if (a.needs_projection()) {
    takes_product = takes_product.logical_and(
        only_rounding_is_left(dot_in_order(z, z), dot_in_order(y, y), epsilon_of(b)).logical_not());
    z = at::where(takes_product, z, at::zeros_like(z));
  }
  // x = α z with the least residual r.
  const auto [product, scale] = of_order_one(a.project(a.apply(z)));
  const auto product2 = dot_in_order(product, product);
  const auto alpha = dot_in_order(b, product) / at::where(product2.gt(0), product2, at::ones_like(product2));
  const auto x = z * scale * alpha, r = b - alpha * product;
  // It is taken where it is better than zero, by more than the rounding of its product where A may be singular.
  const auto b2 = dot_in_order(b, b), left2 = dot_in_order(r, r);
  auto better = left2.lt(b2).logical_and(per_sample(x.isfinite().flatten(1).all(1), b));
  if (a.may_be_singular()) {
    const auto much = left2.le(0.25 * b2);
    auto norm = per_sample(a.norm().detach().reshape({-1}).to(b.options()).nan_to_num(0.0), b);
    const bool may_read = b.is_cpu() && !at::isTensorSubclassLike(b);
    if (may_read && !norm.any().item<bool>() && !much.all().item<bool>()) {  // not known of a Function
      const auto of_b = a.apply(b.detach());
      norm = (dot_in_order(of_b, of_b) / b2).sqrt().nan_to_num(0.0);
    }
    const auto size = norm * (scale * alpha).abs() * dot_in_order(z, z).sqrt();
    better = better & (much | start_gains_more_than_rounding(b2, left2, 0.5 * epsilon_of(b) * size));
  }
  return {at::where(better, x, at::zeros_like(x)).detach(), at::where(better, r, b).detach(), takes_product};
}

}  // namespace prdp
