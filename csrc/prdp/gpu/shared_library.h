#pragma once
#include <dlfcn.h>

#include <string>
#include <vector>

#include "prdp/gpu/runtime.h"

namespace prdp::gpu {

/// A library that is opened when it is needed: nothing of it is linked.
class SharedLibrary {
 public:
  /// The first of these names that somebody has loaded, else the first that can be; none: false.
  explicit SharedLibrary(const std::vector<std::string>& names) {
    for (const int how : {RTLD_NOW | RTLD_NOLOAD, RTLD_NOW})
      for (const auto& name : names)
        if (!handle_) handle_ = dlopen(name.c_str(), how);
  }
  explicit operator bool() const { return handle_; }
  /// Raises Unavailable where there is no such function.
  template <class F>
  void bind(F*& function, const char* name) const {
    function = reinterpret_cast<F*>(dlsym(handle_, name));
    if (!function) throw Unavailable(std::string("the driver or NVRTC is too old: it has no ") + name);
  }

 private:
  void* handle_ = nullptr;
};

}  // namespace prdp::gpu
