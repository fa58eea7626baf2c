#include "prdp/gpu/cuda_runtime.h"

#include <c10/core/CachingDeviceAllocator.h>
#include <c10/core/DeviceGuard.h>
#include <c10/core/impl/VirtualGuardImpl.h>

#include <map>
#include <mutex>

#include "prdp/error_text.h"
#include "prdp/gpu/cuda_driver.h"
#include "prdp/gpu/nvrtc.h"

namespace prdp::gpu {

namespace {

// Numbers of cuda.h.
constexpr int kMultiprocessors = 16, kCapabilityMajor = 75, kCapabilityMinor = 76, kMostBlockMemory = 97;
constexpr int kDynamicMemory = 8;

/// Unknowns of a sample for each block of its team, while there are blocks: sixteen for each thread.
constexpr int64_t kCellsOfBlock = 16384;
/// Of a block's memory, for what the kernel keeps beside its vectors.
constexpr int64_t kOwnBlockMemory = 8192;

int attribute(int which, c10::Device device) {
  const auto& driver = CudaDriver::get();
  int handle = 0, value = 0;
  driver.check(driver.device(&handle, device.index()), "no such device");
  driver.check(driver.attribute(&value, which, handle), "no such attribute");
  return value;
}

void* stream_of(c10::Device device) {
  return c10::impl::VirtualGuardImpl(device.type()).getStream(device).native_handle();
}

/// While it lives, the device is this thread's, and so is its context: a thread of autograd may have none.
class OnDevice {
 public:
  explicit OnDevice(c10::Device device) : guard_(device) {
    const auto& driver = CudaDriver::get();
    void* current = nullptr;
    driver.check(driver.current_context(&current), "no context");
    if (current) return;
    int handle = 0;
    driver.check(driver.device(&handle, device.index()), "no such device");
    driver.check(driver.retain_context(&current, handle), "no context");
    driver.check(driver.set_context(current), "no context");
  }

 private:
  c10::DeviceGuard guard_;
};

bool captures(c10::Device device) {
  const OnDevice here(device);
  const auto& driver = CudaDriver::get();
  int capturing = 0;
  driver.check(driver.is_capturing(stream_of(device), &capturing), "no stream");
  return capturing != 0;
}

/// While it lives, this thread may load a kernel though another one captures a graph, which that would spoil.
class BesideCaptures {
 public:
  BesideCaptures() {
    const auto& driver = CudaDriver::get();
    driver.check(driver.exchange_capture_mode(&mode_), "no mode of capture");
  }
  BesideCaptures(const BesideCaptures&) = delete;
  ~BesideCaptures() { CudaDriver::get().exchange_capture_mode(&mode_); }

 private:
  int mode_ = 2;  // CU_STREAM_CAPTURE_MODE_RELAXED; then that of before
};

/// call(), and once more where memory is short, after torch has let go of what it keeps for later: a kernel's stack is
/// none of torch's memory, and takes some hundred megabytes.
template <class F>
int with_memory(c10::Device device, const F& call) {
  const int result = call();
  if (result != CudaDriver::kOutOfMemory || captures(device)) return result;
  const BesideCaptures relaxed;
  if (auto* const memory = dynamic_cast<c10::DeviceAllocator*>(c10::GetAllocator(device.type()))) memory->emptyCache();
  return call();
}

class CudaKernel final : public Kernel {
 public:
  CudaKernel(c10::Device device, const KernelSource& source) : device_(device), source_(source) {
    const auto& driver = CudaDriver::get();
    TORCH_CHECK(!captures(device), "prdp: a kernel is to be compiled while a CUDA graph is captured; ",
                in_language("call prdp.warm_up() before", "run the same once before"));
    const int capability = 10 * attribute(kCapabilityMajor, device) + attribute(kCapabilityMinor, device);
    const auto binary = nvrtc::compile(source.text, capability);
    const BesideCaptures relaxed;
    void* module = nullptr;
    driver.check(with_memory(device, [&] { return driver.load(&module, binary.data()); }), "the kernel does not load");
    driver.check(driver.function(&function_, module, "prdp_kernel"), "the kernel does not load");
    const auto memory = static_cast<int>(source.block_memory);
    driver.check(driver.set_attribute(function_, kDynamicMemory, memory), "too much memory for a block");
    int blocks = 0;
    driver.check(driver.blocks_at_once(&blocks, function_, static_cast<int>(source.threads), source.block_memory),
                 "no occupancy");
    teams_ = static_cast<int64_t>(blocks) * attribute(kMultiprocessors, device) / source.blocks_of_team;
    if (teams_ == 0) throw Unavailable("the device has no room for a block of this kernel");
  }
  int64_t teams() const override { return teams_; }
  void launch(int64_t teams, const void* arguments) const override {
    const auto& driver = CudaDriver::get();
    const OnDevice here(device_);
    void* all[] = {const_cast<void*>(arguments)};
    const auto blocks = static_cast<unsigned>(teams * source_.blocks_of_team);
    const auto threads = static_cast<unsigned>(source_.threads), memory = static_cast<unsigned>(source_.block_memory);
    const auto start = [&] {  // blocks that wait for each other must all be at work
      return source_.blocks_of_team > 1
                 ? driver.launch_cooperative(function_, blocks, 1, 1, threads, 1, 1, memory, stream_of(device_), all)
                 : driver.launch(function_, blocks, 1, 1, threads, 1, 1, memory, stream_of(device_), all, nullptr);
    };
    driver.check(with_memory(device_, start), "the kernel does not start");
  }

 private:
  c10::Device device_;
  KernelSource source_;
  void* function_ = nullptr;
  int64_t teams_ = 0;
};

class CudaRuntime final : public Runtime {
 public:
  Limits limits(c10::Device device) override {
    const std::lock_guard lock(mutex_);
    const auto found = limits_.find(device.index());
    if (found != limits_.end()) return found->second;
    return limits_[device.index()] = {.block_memory = attribute(kMostBlockMemory, device) - kOwnBlockMemory,
                                      .cells_of_block = kCellsOfBlock,
                                      .threads = 1024,
                                      .blocks = attribute(kMultiprocessors, device)};
  }
  bool is_capturing(c10::Device device) override { return captures(device); }
  std::shared_ptr<const Kernel> kernel(c10::Device device, const KernelSource& source) override {
    const std::lock_guard lock(mutex_);
    auto& [kernel, failure] = kernels_[{device.index(), source.text}];
    if (!failure.empty()) throw Unavailable(failure);
    if (!kernel) {
      try {
        const OnDevice here(device);
        kernel = std::make_shared<CudaKernel>(device, source);
      } catch (const UnavailableNow&) {
        throw;
      } catch (const Unavailable& reason) {  // not tried again, as that may take seconds in every solve
        failure = reason.what();
        throw;
      }
    }
    return kernel;
  }

 private:
  std::mutex mutex_;
  std::map<c10::DeviceIndex, Limits> limits_;
  struct Made {
    std::shared_ptr<const Kernel> kernel{};
    std::string failure{};  // why there is none
  };
  std::map<std::pair<c10::DeviceIndex, std::string>, Made> kernels_;
};

}  // namespace

Runtime& cuda_runtime() {
  static auto* runtime = new CudaRuntime;  // outlives every thread
  return *runtime;
}

}  // namespace prdp::gpu
