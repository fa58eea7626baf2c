#include "prdp/gpu/launch.h"

#include <ATen/Parallel.h>

#include <algorithm>
#include <limits>

#include "prdp/gpu/fall_back.h"
#include "prdp/gpu/kernel_text.h"
#include "prdp/gpu/team_size.h"

namespace prdp::gpu {

namespace {

constexpr int64_t kThreadsOfPoints = 256;

/// A kernel counts its points by an int, and adds the number of its threads to it.
void check_count(int64_t count) {
  if (count > std::numeric_limits<int>::max() / 2)
    throw Unavailable("a batch of " + std::to_string(count) + " numbers is too large for a kernel");
}

std::shared_ptr<const Kernel> kernel_of(Runtime& runtime, c10::Device device, const Body& body, const std::string& loop,
                                        const std::string& sizes, const TeamSize& team) {
  KernelText text;
  text << "#include \"prdp/gpu/device/run_each.h\"\n#include \"" << body.header
       << "\"\nusing namespace prdp::gpu;\nusing Arguments = " << loop << "<" << body.type
       << ">;\nextern \"C\" __global__ void __launch_bounds__(" << team.threads
       << ") prdp_kernel(const __grid_constant__ Arguments arguments) { run" << sizes << "(arguments); }\n";
  auto kernel = runtime.kernel(device, {text.str(), team.threads, /*block_memory=*/0, team.blocks});
  note_made(body.type);
  return kernel;
}

}  // namespace

bool launch_points(c10::Device device, const Body& body, const void* arguments, int64_t count) {
  auto* const runtime = runtime_of(device);
  return runtime && or_fall_back([&] {
           check_count(count);
           const TeamSize team{1, std::min(kThreadsOfPoints, runtime->limits(device).threads)};
           const auto kernel = kernel_of(*runtime, device, body, "EachPoint", "", team);
           kernel->launch(std::min(at::divup(count, team.threads), 4 * kernel->teams()), arguments);
           return true;
         });
}

SampleLoop sample_loop(c10::Device device, const Body& body, int64_t points, int64_t batch) {
  auto* const runtime = runtime_of(device);
  if (!runtime) return {};
  return or_fall_back([&] {
    check_count(points);
    const auto team = team_size(points, runtime->limits(device));
    KernelText sizes;
    sizes << "<" << team.blocks << ", " << team.threads << ">";
    SampleLoop loop{kernel_of(*runtime, device, body, "EachSample", sizes.str(), team)};
    loop.teams = loop.kernel->teams_for(batch, team.blocks);
    loop.memory = {team.blocks, loop.teams, at::TensorOptions().device(device)};
    return loop;
  });
}

bool launch_samples(const SampleLoop& loop, const void* arguments) {
  return or_fall_back([&] {
    loop.kernel->launch(loop.teams, arguments);
    return true;
  });
}

}  // namespace prdp::gpu
