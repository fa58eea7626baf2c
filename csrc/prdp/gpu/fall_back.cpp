#include "prdp/gpu/fall_back.h"

#include <algorithm>
#include <mutex>
#include <set>

namespace prdp::gpu {

namespace {

struct Made {
  std::mutex mutex;
  std::vector<std::string> names;
};
Made& made() {
  static auto* all = new Made;
  return *all;
}

}  // namespace

void fall_back(const std::string& reason) {
  TORCH_CHECK(use() != Use::kRequired, "PRDP_GPU=required: ", reason);
  static std::mutex mutex;
  static auto* said = new std::set<std::string>;
  const std::lock_guard lock(mutex);
  if (said->insert(reason).second)
    TORCH_WARN("prdp: no kernel on this device, so tensor operations take its place, which are slow: ", reason);
}

void note_made(const std::string& name) {
  const std::lock_guard lock(made().mutex);
  auto& names = made().names;
  if (std::find(names.begin(), names.end(), name) == names.end()) names.push_back(name);
}

std::vector<std::string> kernels_made() {
  const std::lock_guard lock(made().mutex);
  return made().names;
}

}  // namespace prdp::gpu
