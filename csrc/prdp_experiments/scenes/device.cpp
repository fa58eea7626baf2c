#include "prdp_experiments/scenes/device.h"

#include <ATen/ATen.h>
#include <torch/cuda.h>

#include "prdp/error_text.h"

namespace prdp {

std::optional<at::Device> device_from_name(const std::string& name) {
  try {
    const at::Device device(name);
    // torch reads "cuda:300" as the number that is left of it in eight bits.
    if (device.str() == name && !(device.is_cpu() && device.has_index())) return device;
  } catch (const c10::Error&) {
  }
  return std::nullopt;
}

at::Device named_device(const std::string& name) {
  const auto found = device_from_name(name);
  TORCH_CHECK_VALUE(found, "device: unknown name '", name, "'; allowed: ", kDeviceNames);
  return *found;
}

void check_device(const at::Device& device) {
  if (device.is_cpu()) return;
  if (device.is_cuda()) {
    const auto gpus = static_cast<int64_t>(torch::cuda::device_count());
    TORCH_CHECK_VALUE(gpus > 0, "device: there is no '", device.str(),
                      "', as torch finds no GPU; 'cpu' is always there");
    TORCH_CHECK_VALUE(device.index() < gpus, "device: there is no '", device.str(), "', as torch finds ", gpus,
                      gpus == 1 ? " GPU" : " GPUs", "; they are counted from 0");
  }
  try {
    at::ones({1}, at::TensorOptions().device(device)).cpu();
  } catch (const c10::Error& error) {
    const auto words = sentence(error.what_without_backtrace());
    TORCH_CHECK_VALUE(false, "device: '", device.str(), "' does not work: ", words.substr(0, words.find(". ")));
  }
}

}  // namespace prdp
