#include "prdp/autograd/unreached_tensors.h"

#include <functional>

#include "prdp/error_text.h"
#include "prdp/operators/function_checks.h"
#include "prdp/operators/graph_leaves.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/registered_products.h"
#include "prdp/operators/with_autograd.h"
#include "prdp/solvers/warnings.h"

namespace prdp {

void warn_of_unreached_tensors(const OperatorSpec& a, const at::Tensor& b) {
  const auto products = products_of(a);
  if (a.transposed || !should_look(std::hash<const void*>()(products->code.get()))) return;
  auto recorded = a;
  for (auto& t : recorded.tensors) t = t.detach().requires_grad_(t.requires_grad());
  const auto product = with_autograd([&] { return make_operator(recorded)->apply(b.detach()); });
  if (!product.requires_grad()) return;  // that of no operation that torch records: the backward pass refuses it
  const auto leaves = leaves_of(product);
  for (size_t i = 0; i < recorded.tensors.size(); ++i) {
    const auto& t = recorded.tensors[i];
    if (!t.requires_grad() || leaves.contains(t.unsafeGetTensorImpl())) continue;
    std::ostringstream key;
    key << "unreached tensor " << products->code.get() << ' ' << i;
    warn_once(key.str(), 0.0, [&](std::ostream& text) {
      text << "Function: tensors[" << i << "] requires grad, but autograd records nothing that " << product_name()
           << " does with it, so that it gets no gradient. A derivative within " << product_name()
           << in_language(" must be torch.func.jvp or vjp, or torch.autograd.grad with create_graph=True",
                          " must be taken with create_graph = true")
           << "; a tensor that it does not use is to be left out";
    });
  }
}

}  // namespace prdp
