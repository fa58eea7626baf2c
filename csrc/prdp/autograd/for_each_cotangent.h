#pragma once
#include <ATen/ATen.h>
#include <ATen/LegacyVmapTransforms.h>

#include <vector>

namespace prdp {

/// backward(cotangent), a gradient for each input. Of the batch of cotangents that autograd.grad(is_grads_batched=True)
/// makes, one is taken after the other, and the gradients are joined again. An empty batch runs with a zero, which
/// tells the shapes of its gradients.
template <class Backward>
std::vector<at::Tensor> for_each_cotangent(const at::Tensor& cotangents, const Backward& backward) {
  if (!at::isBatchedTensor(cotangents)) return backward(cotangents);
  const auto physical = at::MultiBatchVmapTransform::logicalToPhysical(cotangents);
  const int64_t mapped = physical.numBatchDims();
  const auto sizes = physical.tensor().sizes().slice(0, mapped);
  const auto flat = physical.tensor().flatten(0, mapped - 1);  // one axis for all
  auto one = flat.sizes().vec();
  one[0] = 1;
  std::vector<std::vector<at::Tensor>> found;
  for (const auto& cotangent : (flat.size(0) > 0 ? flat : flat.new_zeros(one)).unbind()) {
    const auto gradients = backward(cotangent);
    found.resize(gradients.size());
    for (size_t i = 0; i < gradients.size(); ++i)
      if (gradients[i].defined()) found[i].push_back(gradients[i]);
  }
  std::vector<at::Tensor> joined;
  const auto join = [&](const std::vector<at::Tensor>& all) {
    return physical.getPhysicalToLogicalMap().apply(at::stack(all).narrow(0, 0, flat.size(0)).unflatten(0, sizes));
  };
  for (const auto& of_input : found) joined.push_back(of_input.empty() ? at::Tensor() : join(of_input));
  return joined;
}

}  // namespace prdp
