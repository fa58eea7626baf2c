#include "prdp/operators/graph_leaves.h"

#include <torch/csrc/autograd/function.h>
#include <torch/csrc/autograd/functions/accumulate_grad.h>

#include <vector>

namespace prdp {

Leaves leaves_of(const at::Tensor& t) {
  using torch::autograd::Node;
  if (!t.requires_grad()) return {};
  if (t.is_leaf()) return {t.unsafeGetTensorImpl()};
  Leaves leaves;
  std::vector<Node*> open{t.grad_fn().get()};
  std::unordered_set<Node*> seen(open.begin(), open.end());
  while (!open.empty()) {
    auto* const node = open.back();
    open.pop_back();
    if (const auto* of_leaf = dynamic_cast<torch::autograd::AccumulateGrad*>(node))
      leaves.insert(of_leaf->variable.unsafeGetTensorImpl());
    for (const auto& edge : node->next_edges())
      if (edge.is_valid() && seen.insert(edge.function.get()).second) open.push_back(edge.function.get());
  }
  return leaves;
}

}  // namespace prdp
