#pragma once
#include <locale>
#include <sstream>

namespace prdp::gpu {

/// A stream for the text of a kernel: its numbers have no separators, whatever the user's locale.
struct KernelText : std::ostringstream {
  KernelText() { imbue(std::locale::classic()); }
};

}  // namespace prdp::gpu
