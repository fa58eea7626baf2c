#pragma once
#include <ATen/ATen.h>
#include <ATen/core/grad_mode.h>

namespace prdp {

/// Runs body() recorded by autograd: an op may run where that is switched off, inside a compiled graph
/// for one.
template <class Body>
auto with_autograd(const Body& body) {
  const auto keys = c10::impl::tls_local_dispatch_key_set();
  const c10::impl::ForceDispatchKeyGuard guard(keys.included_,
                                               keys.excluded_ - c10::autograd_dispatch_keyset_with_ADInplaceOrView);
  const at::AutoGradMode record(true);
  return body();
}

}  // namespace prdp
