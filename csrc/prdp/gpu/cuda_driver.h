#pragma once
#include <cstddef>

namespace prdp::gpu {

/// The functions of NVIDIA's driver that the library calls, as cuda.h declares them. A result of 0 is success.
struct CudaDriver {
  static constexpr int kOutOfMemory = 2;

  int (*init)(unsigned);
  int (*version)(int*);
  int (*error_text)(int, const char**);
  int (*device)(int*, int index);
  int (*attribute)(int*, int which, int device);
  int (*retain_context)(void**, int device);
  int (*current_context)(void**);
  int (*set_context)(void*);
  int (*load)(void** module, const void* image);
  int (*function)(void**, void* module, const char* name);
  int (*set_attribute)(void* function, int which, int value);
  int (*blocks_at_once)(int*, void* function, int threads, size_t memory);
  int (*is_capturing)(void* stream, int*);
  int (*exchange_capture_mode)(int*);
  int (*launch)(void* function, unsigned x, unsigned y, unsigned z, unsigned threads, unsigned, unsigned,
                unsigned memory, void* stream, void** arguments, void** extra);
  int (*launch_cooperative)(void* function, unsigned x, unsigned y, unsigned z, unsigned threads, unsigned, unsigned,
                            unsigned memory, void* stream, void** arguments);

  /// Raises Unavailable where there is no driver.
  static const CudaDriver& get();
  /// Raises Unavailable, in the driver's words, unless `result` is 0.
  void check(int result, const char* what) const;
};

}  // namespace prdp::gpu
