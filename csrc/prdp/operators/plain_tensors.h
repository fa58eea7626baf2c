#pragma once
#include <ATen/TensorSubclassLikeUtils.h>
#include <ATen/functorch/DynamicLayer.h>
#include <ATen/record_function.h>
#include <c10/core/impl/LocalDispatchKeySet.h>
#include <torch/csrc/autograd/forward_grad.h>

#include <algorithm>
#include <vector>

/// Tests for tensors that are more than plain numbers in memory.
namespace prdp {

/// Whether the memory of a tensor holds its values, so that a kernel may be called directly. Other tensors need the
/// dispatcher: those that are fake, wrapped, negated or conjugated by a bit, or zero without memory.
inline bool is_plain(const at::Tensor& t) {
  constexpr c10::DispatchKeySet lazy(
      {c10::DispatchKey::Negative, c10::DispatchKey::Conjugate, c10::DispatchKey::ZeroTensor});
  return !at::isTensorSubclassLike(t) && !t.key_set().has_any(lazy);
}
inline bool all_plain(at::TensorList tensors) { return std::all_of(tensors.begin(), tensors.end(), is_plain); }

/// Whether an op that this thread calls with plain tensors comes to its autograd kernel and nowhere else: no mode,
/// transform, trace or autocast is on; and no profiler.
inline bool no_mode_but_a_profiler_is_on() {
  const auto here = c10::impl::tls_local_dispatch_key_set();
  return here.included_ == c10::default_included_set && here.excluded_ == c10::default_excluded_set;
}
inline bool no_mode_is_on() { return no_mode_but_a_profiler_is_on() && !at::hasCallbacks(); }

/// Whether a tensor is dual: it carries a tangent of forward mode.
inline bool has_tangent(const at::Tensor& t) { return t.defined() && t._fw_grad(/*level=*/0).defined(); }
/// Whether a level of forward mode is open.
inline bool in_forward_mode() { return torch::autograd::ForwardADLevel::try_get_by_idx(0) != nullptr; }
/// t without its tangent.
inline at::Tensor primal(const at::Tensor& t) { return has_tangent(t) ? t._fw_primal(/*level=*/0) : t; }
inline bool any_tangent(at::TensorList tensors) { return std::any_of(tensors.begin(), tensors.end(), has_tangent); }
/// Whether a derivative is asked for with respect to one of them.
inline bool any_needs_derivative(at::TensorList tensors) {
  const auto requires_grad = [](const at::Tensor& t) { return t.requires_grad(); };
  return any_tangent(tensors) ||
         (at::GradMode::is_enabled() && std::any_of(tensors.begin(), tensors.end(), requires_grad));
}

/// Whether a transform of torch.func is running.
inline bool in_torch_func() { return at::functorch::maybeCurrentDynamicLayer().has_value(); }
/// Whether the innermost of them is vmap.
inline bool in_vmap() {
  const auto layer = at::functorch::maybeCurrentDynamicLayer();
  return layer && layer->key() == at::functorch::TransformType::Vmap;
}

}  // namespace prdp
