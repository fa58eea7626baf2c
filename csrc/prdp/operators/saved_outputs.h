#pragma once
#include <torch/csrc/autograd/custom_function.h>

#include <utility>

namespace prdp {

/// F::apply(args), where F::forward saves a tensor that it returns, and holds it in `saved` as well.
///
/// A hook that packs saved tensors may raise, as torch.utils.checkpoint does to end a recomputation. Torch then leaves
/// what was to be saved in the node, and that tensor and the node would hold each other for ever.
template <class F, class... Args>
auto apply_with_saved_output(at::Tensor& saved, Args&&... args) {
  try {
    auto out = F::apply(std::forward<Args>(args)...);
    saved.reset();
    return out;
  } catch (...) {
    const auto node = saved.defined() ? saved.grad_fn() : decltype(saved.grad_fn()){};
    if (auto* const made = dynamic_cast<torch::autograd::CppNode<F>*>(node.get())) made->ctx_.save_for_backward({});
    saved.reset();
    throw;
  }
}

}  // namespace prdp
