// A libcuda.so.1 without a GPU. It refuses, as a driver that is too old for this program does; with -DWITHOUT_NEWER it
// lacks functions of today; with -DWORKS it has devices of two multiprocessors, which run a block each unless CROWDED is
// set. Its VERSION is 13000. Streams are captured where CAPTURING is set, and memory is short for as many modules as
// SHORT says. It prints each launch.
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#ifdef WORKS
#define RESULT 0
#else
#define RESULT 35
#endif
#define ANSWERS(name) \
  int name() { return RESULT; }
int cuGetErrorString(int code, const char** text) {
  *text = code == 35 ? "CUDA driver version is insufficient for CUDA runtime version"
          : code == 2 ? "out of memory"
                      : "?";
  return 0;
}
int cuDeviceGetAttribute(int* value, int which, int device) {
  enum { kMultiprocessors = 16, kCapabilityMajor = 75 };
  *value = which == kMultiprocessors ? 2 : which == kCapabilityMajor ? 9 : 0;
  return RESULT;
}
int cuOccupancyMaxActiveBlocksPerMultiprocessor(int* blocks, void* function, int threads, size_t memory) {
  *blocks = getenv("CROWDED") == NULL;
  return RESULT;
}
int cuStreamIsCapturing(void* stream, int* status) {
  *status = getenv("CAPTURING") != NULL;
  return RESULT;
}
int cuDriverGetVersion(int* version) {
  const char* const of_cuda = getenv("VERSION");
  *version = of_cuda ? atoi(of_cuda) : 13000;
  return RESULT;
}
int cuDeviceGet(int* device, int index) {
  *device = index;
  return RESULT;
}
// A context is the number of its device, from one on; a thread has none at first.
static _Thread_local intptr_t context;
int cuDevicePrimaryCtxRetain(void** of_device, int device) {
  *of_device = (void*)(intptr_t)(device + 1);
  return RESULT;
}
int cuCtxGetCurrent(void** current) {
  *current = (void*)context;
  return RESULT;
}
int cuCtxSetCurrent(void* current) {
  context = (intptr_t)current;
  return RESULT;
}
int cuModuleLoadData(void** module, const void* image) {
  static int tries = 0;
  const char* const without_memory = getenv("SHORT");
  return without_memory && tries++ < atoi(without_memory) ? 2 : RESULT;
}
static int most_memory;
int cuFuncSetAttribute(void* function, int which, int value) {
  enum { kDynamicMemory = 8 };
  if (which == kDynamicMemory) most_memory = value;
  return RESULT;
}
static int print_launch(const char* how, unsigned x, unsigned y, unsigned z, unsigned threads, unsigned by,
                        unsigned bz, unsigned memory, void* stream, void** arguments) {
  if (y != 1 || z != 1 || by != 1 || bz != 1 || (int)memory > most_memory) return 1;
  printf("%s of %u blocks of %u threads with %u bytes in context %d on stream %d, argument %d\n", how, x, threads, memory,
         (int)context, (int)(intptr_t)stream, *(int*)arguments[0]);
  fflush(stdout);
  return RESULT;
}
int cuLaunchKernel(void* function, unsigned x, unsigned y, unsigned z, unsigned threads, unsigned by, unsigned bz,
                   unsigned memory, void* stream, void** arguments, void** extra) {
  return extra ? 1 : print_launch("launch", x, y, z, threads, by, bz, memory, stream, arguments);
}
#ifndef WITHOUT_NEWER
int cuLaunchCooperativeKernel(void* function, unsigned x, unsigned y, unsigned z, unsigned threads, unsigned by,
                              unsigned bz, unsigned memory, void* stream, void** arguments) {
  return print_launch("cooperative launch", x, y, z, threads, by, bz, memory, stream, arguments);
}
#endif
ANSWERS(cuInit)
ANSWERS(cuThreadExchangeStreamCaptureMode)
ANSWERS(cuModuleGetFunction)
