/// libFuzzer's entry; PRDP_FUZZ_TARGET names the target.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>

#include "targets.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  static const auto* const target = [] {
    const char* wanted = std::getenv("PRDP_FUZZ_TARGET");
    for (const auto& known : prdp_fuzz::targets())
      if (wanted && std::string(wanted) == known.name) return &known;
    std::fprintf(stderr, "PRDP_FUZZ_TARGET: expected scene, files or operators\n");
    std::exit(2);
  }();
  target->run({reinterpret_cast<const char*>(data), size});
  return 0;
}
