#include "prdp/gpu/cuda_driver.h"

#include "prdp/gpu/shared_library.h"

namespace prdp::gpu {

const CudaDriver& CudaDriver::get() {
  static const CudaDriver driver = [] {
    const SharedLibrary library({"libcuda.so.1"});
    if (!library) throw Unavailable("there is no libcuda.so.1: is NVIDIA's driver installed?");
    CudaDriver d{};
    library.bind(d.init, "cuInit");
    library.bind(d.version, "cuDriverGetVersion");
    library.bind(d.error_text, "cuGetErrorString");
    library.bind(d.device, "cuDeviceGet");
    library.bind(d.attribute, "cuDeviceGetAttribute");
    library.bind(d.retain_context, "cuDevicePrimaryCtxRetain");
    library.bind(d.current_context, "cuCtxGetCurrent");
    library.bind(d.set_context, "cuCtxSetCurrent");
    library.bind(d.load, "cuModuleLoadData");
    library.bind(d.function, "cuModuleGetFunction");
    library.bind(d.set_attribute, "cuFuncSetAttribute");
    library.bind(d.blocks_at_once, "cuOccupancyMaxActiveBlocksPerMultiprocessor");
    library.bind(d.is_capturing, "cuStreamIsCapturing");
    library.bind(d.exchange_capture_mode, "cuThreadExchangeStreamCaptureMode");
    library.bind(d.launch, "cuLaunchKernel");
    library.bind(d.launch_cooperative, "cuLaunchCooperativeKernel");
    d.check(d.init(0), "the driver does not start");
    return d;
  }();
  return driver;
}

void CudaDriver::check(int result, const char* what) const {
  if (result == 0) return;
  const char* text = nullptr;
  error_text(result, &text);
  const std::string why =
      std::string(what) + ": " + (text ? text : "unknown error") + " (" + std::to_string(result) + ")";
  constexpr int first_of_capture = 900, last_of_capture = 909;  // CUresult in cuda.h
  if (result == kOutOfMemory || (result >= first_of_capture && result <= last_of_capture)) throw UnavailableNow(why);
  throw Unavailable(why);
}

}  // namespace prdp::gpu
