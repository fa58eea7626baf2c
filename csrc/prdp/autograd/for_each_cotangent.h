#pragma once
#include <ATen/ATen.h>
#include <ATen/LegacyVmapTransforms.h>

#include <vector>

namespace prdp {

/// backward(cotangent), a gradient for each input. Of the batch of cotangents that autograd.grad(is_grads_batched=True)
/// makes, one is taken after the other, and the gradients are joined again.
template <class Backward>
std::vector<at::Tensor> for_each_cotangent(const at::Tensor& cotangents, const Backward& backward) {
  if (!at::isBatchedTensor(cotangents)) return backward(cotangents);
  const auto physical = at::MultiBatchVmapTransform::logicalToPhysical(cotangents);
  const int64_t mapped = physical.numBatchDims();
  const auto sizes = physical.tensor().sizes().slice(0, mapped);
  std::vector<std::vector<at::Tensor>> found;
  for (const auto& cotangent : physical.tensor().flatten(0, mapped - 1).unbind()) {
    const auto gradients = backward(cotangent);
    found.resize(gradients.size());
    for (size_t i = 0; i < gradients.size(); ++i)
      if (gradients[i].defined()) found[i].push_back(gradients[i]);
  }
  std::vector<at::Tensor> joined;
  for (const auto& of_input : found)
    joined.push_back(of_input.empty()
                         ? at::Tensor()
                         : physical.getPhysicalToLogicalMap().apply(at::stack(of_input).unflatten(0, sizes)));
  return joined;
}

}  // namespace prdp
