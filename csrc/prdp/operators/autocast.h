#pragma once
#include <c10/core/impl/LocalDispatchKeySet.h>

namespace prdp {

/// While it lives, torch.autocast does not change the dtypes of operations on this thread.
class WithoutAutocast {
 public:
  WithoutAutocast() : guard_(c10::autocast_dispatch_keyset) {}

 private:
  c10::impl::ExcludeDispatchKeyGuard guard_;
};

}  // namespace prdp
