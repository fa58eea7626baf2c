#pragma once
#include <ATen/ATen.h>
#include <ATen/SavedTensorHooks.h>
#include <ATen/core/grad_mode.h>
#include <c10/core/InferenceMode.h>
#include <torch/csrc/autograd/autograd.h>

#include <optional>
#include <vector>

namespace prdp {

/// Runs body() recorded by autograd: an op may run where that is switched off, as inside a compiled graph or in
/// inference mode.
template <class Body>
auto with_autograd(const Body& body) {
  std::optional<c10::InferenceMode> recorded;
  if (c10::InferenceMode::is_enabled()) recorded.emplace(false);
  const auto keys = c10::impl::tls_local_dispatch_key_set();
  const c10::impl::ForceDispatchKeyGuard guard(keys.included_,
                                               keys.excluded_ - c10::autograd_dispatch_keyset_with_ADInplaceOrView);
  const at::AutoGradMode record(true);
  return body();
}

/// For a product that is recorded to look at it, and thrown away: hooks of saved tensors do not see it.
/// torch.utils.checkpoint counts what they see, and a repetition may have nothing to look at.
struct UnseenByHooks {
  const bool before = at::SavedTensorDefaultHooks::set_tracing(true);
  UnseenByHooks() = default;
  UnseenByHooks(const UnseenByHooks&) = delete;
  ~UnseenByHooks() { at::SavedTensorDefaultHooks::set_tracing(before); }
};

/// grad() of torch: a gradient in the place of each input, undefined where `needed` holds 0 or there is none. Outputs
/// without a gradient or a cotangent contribute nothing.
inline std::vector<at::Tensor> gradients_of(const std::vector<at::Tensor>& outputs,
                                            const std::vector<at::Tensor>& cotangents,
                                            const std::vector<at::Tensor>& inputs, at::IntArrayRef needed,
                                            bool create_graph = false) {
  std::vector<at::Tensor> of, bars, wanted, all(inputs.size());
  for (size_t i = 0; i < outputs.size(); ++i)
    if (outputs[i].defined() && outputs[i].requires_grad() && cotangents[i].defined()) {
      of.push_back(outputs[i]);
      bars.push_back(cotangents[i]);
    }
  for (size_t i = 0; i < inputs.size(); ++i)
    if (needed[i]) wanted.push_back(inputs[i]);
  if (of.empty() || wanted.empty()) return all;
  const auto found = torch::autograd::grad(of, wanted, bars, create_graph, create_graph, /*allow_unused=*/true);
  for (size_t i = 0, next = 0; i < inputs.size(); ++i)
    if (needed[i]) all[i] = found[next++];
  return all;
}

}  // namespace prdp
