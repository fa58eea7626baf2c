/// libFuzzer's entry; PRDP_FUZZ_TARGET names the target.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <new>
#include <string>

#include "targets.h"

/// torch's reader of archives frees nothing of one that it refuses (mz_zip_reader_init, whose caller throws). Reports of
/// that at the end of a run look as if the empty input had caused them.
extern "C" const char* __lsan_default_suppressions() { return "leak:mz_zip_reader_\n"; }

/// It also asks for as much memory as a damaged archive says. AddressSanitizer ends the process where there is not so
/// much; the usual new throws, and the archive is refused.
void* operator new(std::size_t size) {
  constexpr std::size_t kMost = std::size_t{1} << 31;
  void* const memory = size < kMost ? std::malloc(size ? size : 1) : nullptr;
  if (!memory) throw std::bad_alloc();
  return memory;
}
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }

/// Memory of the other forms of new, which stay AddressSanitizer's, is given back by these, too.
extern "C" const char* __asan_default_options() { return "alloc_dealloc_mismatch=0"; }

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
