#include "prdp/gpu/runtime.h"

#include <array>
#include <atomic>
#include <cstdlib>
#include <utility>

#include "prdp/gpu/cuda_runtime.h"

namespace prdp::gpu {

namespace {

using Table = std::array<std::atomic<Runtime*>, static_cast<size_t>(c10::COMPILE_TIME_MAX_DEVICE_TYPES)>;

Table& table() {
  static auto* runtimes = [] {
    auto* made = new Table{};
    (*made)[static_cast<size_t>(c10::DeviceType::CUDA)] = &cuda_runtime();
    return made;
  }();
  return *runtimes;
}

thread_local bool takes_none = false;

}  // namespace

WithoutKernels::WithoutKernels() : before_(std::exchange(takes_none, true)) {}
WithoutKernels::~WithoutKernels() { takes_none = before_; }

Runtime* runtime_of(c10::Device device) {
  if (takes_none) return nullptr;
  auto* const runtime = table()[static_cast<size_t>(device.type())].load(std::memory_order_relaxed);
  return runtime && use() != Use::kOff ? runtime : nullptr;
}

void set_runtime(c10::DeviceType type, Runtime* runtime) { table()[static_cast<size_t>(type)] = runtime; }

Use use() {
  const char* const set = std::getenv("PRDP_GPU");
  const std::string value = set ? set : "auto";
  if (value == "auto" || value.empty()) return Use::kAuto;
  if (value == "required") return Use::kRequired;
  TORCH_CHECK_VALUE(value == "off", "PRDP_GPU: expected \"auto\", \"required\" or \"off\", got \"", value, "\"");
  return Use::kOff;
}

}  // namespace prdp::gpu
