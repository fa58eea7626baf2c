#include "prdp/autograd/unreached_tensors.h"

#include <functional>

#include "prdp/error_text.h"
#include "prdp/operators/function_checks.h"
#include "prdp/operators/graph_leaves.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/tensors.h"
#include "prdp/operators/with_autograd.h"
#include "prdp/solvers/warnings.h"

namespace prdp {

namespace {

/// Whether A v, which is `before`, depends on the tensor with this index.
bool changes_product(const OperatorSpec& a, const at::Tensor& v, const at::Tensor& before, size_t index) {
  const at::NoGradGuard no_grad;
  auto other = a;
  other.tensors = detached(a.tensors);
  auto& t = other.tensors[index];
  t = t + 0.01 * (t.abs() + 1.0) * at::ones_like(t).cumsum(-1).sin();
  const auto change = make_operator(other)->apply(v) - before;
  return (change.abs().max() > 1e3 * epsilon_of(v) * before.abs().max()).item<bool>();
}

void look(const OperatorSpec& a, const at::Tensor& b) {
  const UnseenByHooks unseen;
  const auto products = products_of(a);
  auto recorded = a;
  for (auto& t : recorded.tensors) t = t.detach().requires_grad_(t.requires_grad());
  const auto product = with_autograd([&] { return make_operator(recorded)->apply(b.detach()); });
  if (!product.requires_grad()) return;  // that of no operation that torch records: the backward pass refuses it
  const auto leaves = leaves_of(product);
  for (size_t i = 0; i < recorded.tensors.size(); ++i) {
    const auto& t = recorded.tensors[i];
    const bool is_out_of_reach = t.requires_grad() && !leaves.contains(t.unsafeGetTensorImpl());
    if (!is_out_of_reach || !at::isFloatingType(t.scalar_type()) ||
        !changes_product(a, b.detach(), product.detach(), i))
      continue;
    std::ostringstream key;
    key << "unreached tensor " << products->code.get() << ' ' << i;
    warn_once(key.str(), 0.0, [&](std::ostream& text) {
      text << "Function: tensors[" << i << "] requires grad, but autograd records nothing that " << product_name()
           << " does with it, so that it gets no gradient. A derivative within " << product_name()
           << in_language(" must be torch.func.jvp or vjp, or torch.autograd.grad with create_graph=True",
                          " must be taken with create_graph = true");
    });
  }
}

}  // namespace

void warn_of_unreached_tensors(const OperatorSpec& a, const at::Tensor& b) {
  if (a.transposed || b.numel() == 0 || !should_look(std::hash<const void*>()(products_of(a)->code.get()))) return;
  try {
    look(a, b);
  } catch (const std::exception&) {  // a product that torch cannot record: the backward pass says so, if there is one
  }
}

}  // namespace prdp
