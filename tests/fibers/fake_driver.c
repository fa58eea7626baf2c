// A libcuda.so.1 without a GPU. It refuses, as a driver that is too old for this program does; with -DWITHOUT_NEWER it
// lacks functions of today; with -DWORKS it has a device of two multiprocessors, which run a block each, and its stream
// is captured where CAPTURING is set.
#include <stddef.h>
#include <stdlib.h>
#ifdef WORKS
#define RESULT 0
#else
#define RESULT 35
#endif
#define ANSWERS(name) \
  int name() { return RESULT; }
int cuGetErrorString(int code, const char** text) {
  *text = code == 35 ? "CUDA driver version is insufficient for CUDA runtime version" : "?";
  return 0;
}
int cuDeviceGetAttribute(int* value, int which, int device) {
  enum { kMultiprocessors = 16, kCapabilityMajor = 75 };
  *value = which == kMultiprocessors ? 2 : which == kCapabilityMajor ? 9 : 0;
  return RESULT;
}
int cuOccupancyMaxActiveBlocksPerMultiprocessor(int* blocks, void* function, int threads, size_t memory) {
  *blocks = 1;
  return RESULT;
}
int cuStreamIsCapturing(void* stream, int* status) {
  *status = getenv("CAPTURING") != NULL;
  return RESULT;
}
ANSWERS(cuInit)
ANSWERS(cuDeviceGet)
ANSWERS(cuDevicePrimaryCtxRetain)
ANSWERS(cuCtxGetCurrent)
ANSWERS(cuCtxSetCurrent)
ANSWERS(cuModuleLoadData)
ANSWERS(cuModuleGetFunction)
ANSWERS(cuFuncSetAttribute)
ANSWERS(cuLaunchKernel)
#ifndef WITHOUT_NEWER
ANSWERS(cuLaunchCooperativeKernel)
#endif
