#pragma once
#include <ATen/ATen.h>

#include <algorithm>
#include <atomic>
#include <memory>
#include <stdexcept>
#include <string>

/// Where kernels are compiled and launched: CUDA, or, in the tests, fibers on the CPU.
namespace prdp::gpu {

/// Why there is no kernel: one sentence.
class Unavailable : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// The same, of a moment: another try may succeed, as where memory was short.
class UnavailableNow : public Unavailable {
 public:
  using Unavailable::Unavailable;
};

/// What a kernel may use of a device.
struct Limits {
  int64_t block_memory;     // bytes that the vectors of a block may take
  int64_t cells_of_block;   // unknowns of a sample for each block of its team
  int64_t threads;          // of a block, at most
  int64_t blocks;           // of a team, at most: so many are at work at the same time
};

/// A kernel in the device's language, with what its launch needs.
struct KernelSource {
  std::string text;
  int64_t threads, block_memory, blocks_of_team;
};

/// What is known of a kernel by its first result, which is compared with tensor operations.
enum class Trust { kUnknown, kGood, kNone };

/// A kernel on a device.
class Kernel {
 public:
  mutable std::atomic<Trust> trust = Trust::kUnknown;
  mutable std::atomic<int> checks = 0;  // of its results

  virtual ~Kernel() = default;
  /// Teams that can be at work at the same time.
  virtual int64_t teams() const = 0;
  /// Teams for a batch. Those of several blocks meet, so all must be at work at once; so should those with memory of
  /// their own, of which there may be little. Others may queue.
  int64_t teams_for(int64_t batch, int64_t blocks_of_team, bool have_memory = false) const {
    return std::min(batch, blocks_of_team > 1 || have_memory ? teams() : 4 * teams());
  }
  /// On the device's current stream. `arguments` are what its text calls Arguments.
  virtual void launch(int64_t teams, const void* arguments) const = 0;
};

class Runtime {
 public:
  virtual ~Runtime() = default;
  virtual Limits limits(c10::Device device) = 0;
  /// Compiles it, or finds it. Raises Unavailable.
  virtual std::shared_ptr<const Kernel> kernel(c10::Device device, const KernelSource& source) = 0;
  /// Whether the device's current stream captures a graph: the host may not wait for it, and what its launches write
  /// is not there before the graph is run.
  virtual bool is_capturing(c10::Device device) = 0;
};

/// The runtime of a device; null if it has none.
Runtime* runtime_of(c10::Device device);
/// For tests: what runs the kernels of this kind of device from here on; null: nothing.
void set_runtime(c10::DeviceType type, Runtime* runtime);

/// While it lives, its thread takes no kernels.
class WithoutKernels {
 public:
  WithoutKernels();
  WithoutKernels(const WithoutKernels&) = delete;
  ~WithoutKernels();

 private:
  bool before_;
};

/// PRDP_GPU: kernels where there are any; an error where there are none; none.
enum class Use { kAuto, kRequired, kOff };
Use use();

}  // namespace prdp::gpu
