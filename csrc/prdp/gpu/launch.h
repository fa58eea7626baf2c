#pragma once
#include <ATen/ATen.h>

#include "prdp/gpu/device/each.h"
#include "prdp/gpu/runtime.h"
#include "prdp/gpu/team_memory.h"

/// Loops over points, or over the samples of a batch, in one launch.
namespace prdp::gpu {

/// What is called in a loop: "FlowChange<float>", and the header of gpu/device that has it.
struct Body {
  std::string type, header;
};

bool launch_points(c10::Device device, const Body& body, const void* arguments, int64_t count);

/// The kernel of a loop over samples, and the memory of its teams.
struct SampleLoop {
  std::shared_ptr<const Kernel> kernel{};  // null: there is none
  int64_t teams = 0;
  TeamMemory memory{};
};
SampleLoop sample_loop(c10::Device device, const Body& body, int64_t points, int64_t batch);
bool launch_samples(const SampleLoop& loop, const void* arguments);

/// Each returns false where there is no kernel: the device has no runtime, or fall_back() said why.
template <class Of>
bool each_point(c10::Device device, const Body& body, const Of& of, int64_t count) {
  const EachPoint<Of> arguments{of, static_cast<int>(count)};
  return launch_points(device, body, &arguments, count);
}
/// `points`: of a sample.
template <class Of>
bool each_sample(c10::Device device, const Body& body, const Of& of, int64_t points, int64_t batch) {
  const auto loop = sample_loop(device, body, points, batch);
  EachSample<Of> arguments{of, static_cast<int>(batch), nullptr, nullptr};
  loop.memory.put_into(arguments);
  return loop.kernel && launch_samples(loop, &arguments);
}

}  // namespace prdp::gpu
