#pragma once
#include <c10/core/Device.h>

#include <optional>
#include <string>

namespace prdp {

/// What may be given as a device, for errors.
inline constexpr const char* kDeviceNames = "cpu, cuda, cuda:N";

/// The device of a name, such as "cuda:1"; nullopt for what names none.
std::optional<at::Device> device_from_name(const std::string& name);
/// The same. Raises ValueError for what names none.
at::Device named_device(const std::string& name);
/// Raises ValueError, in one sentence, if there is no such device here. To be called before any work.
void check_device(const at::Device& device);

}  // namespace prdp
