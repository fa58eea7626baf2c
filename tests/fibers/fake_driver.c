// A libcuda.so.1 that refuses: as a driver that is too old for this program does, or, with -DWITHOUT_NEWER, one that
// lacks functions of today.
#define REFUSES(name) \
  int name() { return 35; }
int cuGetErrorString(int code, const char** text) {
  *text = code == 35 ? "CUDA driver version is insufficient for CUDA runtime version" : "?";
  return 0;
}
REFUSES(cuInit)
REFUSES(cuDeviceGet)
REFUSES(cuDeviceGetAttribute)
REFUSES(cuDevicePrimaryCtxRetain)
REFUSES(cuCtxGetCurrent)
REFUSES(cuCtxSetCurrent)
REFUSES(cuModuleLoadData)
REFUSES(cuModuleGetFunction)
REFUSES(cuFuncSetAttribute)
REFUSES(cuOccupancyMaxActiveBlocksPerMultiprocessor)
REFUSES(cuStreamIsCapturing)
REFUSES(cuLaunchKernel)
#ifndef WITHOUT_NEWER
REFUSES(cuLaunchCooperativeKernel)
#endif
