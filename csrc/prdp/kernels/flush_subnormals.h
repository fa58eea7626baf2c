#pragma once
#if defined(__SSE2__)
#include <xmmintrin.h>
#endif

namespace prdp::kernels {

/// While it lives, this thread takes numbers below the normal ones for zero. The factors of a large, dominant matrix
/// are full of them, far from the diagonal, and processors of x86 compute with them many times slower.
class FlushSubnormals {
 public:
  FlushSubnormals(const FlushSubnormals&) = delete;
  FlushSubnormals& operator=(const FlushSubnormals&) = delete;
#if defined(__SSE2__)
  FlushSubnormals() : before_(_mm_getcsr()) { _mm_setcsr(before_ | kOperandsAndResults); }
  ~FlushSubnormals() { _mm_setcsr(before_); }

 private:
  static constexpr unsigned kOperandsAndResults = 0x8040;
  unsigned before_;
#else
  FlushSubnormals() {}  // others do not mind
#endif
};

}  // namespace prdp::kernels
