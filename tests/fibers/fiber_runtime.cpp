// Kernels of a GPU on the CPU: compiled by the host's compiler, run by fibers.h. With it, tensors of the CPU take the
// way that those of a GPU take, from the operator to the report.

#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <dlfcn.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <mutex>
#include <thread>
#include <vector>

#include "prdp/gpu/cuda_runtime.h"
#include "prdp/gpu/nvrtc.h"
#include "prdp/gpu/runtime.h"
#include "prdp/solvers/solve_kernel_text.h"

namespace {

namespace fs = std::filesystem;
using prdp::gpu::KernelSource;
using prdp::gpu::Limits;
using prdp::gpu::Unavailable;

struct Settings {
  Limits limits{};
  int order = 0;  // of fibers::Order
  int left_out = 0;  // the line of the barrier that is left out; 0: none
  bool poisons = true;  // memory of a block
  bool captures = false;  // a graph, on all streams
  bool refuses = false;  // every kernel
  bool from_ptx = false;  // the fibers run what NVRTC makes of the text
};
Settings settings;
std::vector<KernelSource> asked_for;  // since kernels serve the CPU, each once
std::atomic<int64_t> launches = 0;

std::string read(const fs::path& file) {
  std::ifstream in(file);
  return {std::istreambuf_iterator<char>(in), {}};
}

/// Where compiled kernels are kept: a folder for each version of the text that they include.
const fs::path& folder() {
  static const fs::path made = [] {
    std::string text;
    for (const char* file : {"fibers.h", "ptx.h", "ptx.py", "ptx_instructions.py"})
      text += read(fs::path(PRDP_FIBERS) / file);
    for (const char* part : {"prdp/gpu/device", "prdp/solvers", "prdp/kernels"})
      for (const auto& file : fs::directory_iterator(fs::path(PRDP_CSRC) / part))
        if (file.path().extension() == ".h") text += read(file);
    if (std::getenv("PRDP_FIBERS_TSAN")) text += "watched";
    const auto name = "prdp-fibers-" + std::to_string(getuid()) + "-" + std::to_string(std::hash<std::string>()(text));
    fs::create_directories(fs::temp_directory_path() / name);
    return fs::temp_directory_path() / name;
  }();
  return made;
}

/// Runs the host's compiler; what it makes appears whole.
void compile(const std::string& arguments, const fs::path& result) {
  if (fs::exists(result)) return;
  const auto part = result.string() + "." + std::to_string(getpid()), log = part + ".log";
  static const std::string watch = std::getenv("PRDP_FIBERS_TSAN") ? " -fsanitize=thread -g" : "";
  const std::string command = "c++ -std=c++20 -O1 -ffp-contract=off -fno-gnu-unique -fPIC -pthread" + watch + " -I" +
                              folder().string() + " -I" + PRDP_CSRC + " " + arguments + " -o " + part + " 2> " + log;
  if (std::system(command.c_str()) != 0) throw Unavailable("the host's compiler fails: " + read(log));
  fs::remove(log);
  fs::rename(part, result);
}

/// Compiles `text`; returns the library's file.
std::string compiled(const std::string& text) {
  const auto header = folder() / "fibers.h",
             source = folder() / (std::to_string(std::hash<std::string>()(text)) + ".cpp");
  for (const char* file : {"fibers.h", "ptx.h"})
    if (!fs::exists(folder() / file))
      fs::copy_file(fs::path(PRDP_FIBERS) / file, folder() / file, fs::copy_options::skip_existing);
  compile("-x c++-header " + header.string(), header.string() + ".gch");
  std::ofstream(source) << text;
  const auto library = source.string() + ".so";
  compile("-shared " + source.string(), library);
  return library;
}

/// PTX of the newest device that NVRTC knows, which compiles on to that one's binary, as C++ (ptx.py).
std::string ptx_as_cpp(const std::string& text) {
  constexpr int beyond_all = 999;
  const auto part =
      (folder() / std::to_string(std::hash<std::string>()(text + "PTX"))).string() + "." + std::to_string(getpid());
  const auto ptx = part + ".ptx", cpp = part + ".cpp", log = part + ".log";
  std::ofstream(ptx) << prdp::gpu::nvrtc::compile(text, beyond_all);
  const std::string command = std::string("python3 ") + PRDP_FIBERS + "/ptx.py " + ptx + " " + cpp + " 2> " + log;
  const bool failed = std::system(command.c_str()) != 0;
  const auto made = read(failed ? log : cpp);
  for (const auto& file : {ptx, cpp, log}) fs::remove(file);
  if (failed) throw Unavailable("ptx.py fails: " + made);
  return made;
}

/// The text itself, with the function that launches its kernel.
std::string with_run(const std::string& text) {
  return "#include \"fibers.h\"\n" + text + "PRDP_FIBERS_RUN(prdp_kernel(*static_cast<const Arguments*>(arguments)))\n";
}

class FiberKernel final : public prdp::gpu::Kernel {
 public:
  explicit FiberKernel(const KernelSource& source) : source_(source) {
    const auto text = settings.from_ptx ? ptx_as_cpp(source.text) : with_run(source.text);
    void* const library = dlopen(compiled(text).c_str(), RTLD_NOW);
    if (!library) throw Unavailable(dlerror());
    run_ = reinterpret_cast<decltype(run_)>(dlsym(library, "run"));
  }
  int64_t teams() const override { return 2; }
  void launch(int64_t teams, const void* arguments) const override {
    constexpr long spare = 64;
    ++launches;
    const bool regular =
        run_(arguments, static_cast<int>(teams * source_.blocks_of_team), static_cast<int>(source_.threads),
             source_.block_memory + spare, settings.order, settings.left_out, settings.poisons);
    TORCH_CHECK(regular, "fibers: some wait where others do not");
  }

 private:
  KernelSource source_;
  int (*run_)(const void*, int, int, long, int, int, bool);
};

class FiberRuntime final : public prdp::gpu::Runtime {
 public:
  Limits limits(c10::Device) override { return settings.limits; }
  std::shared_ptr<const prdp::gpu::Kernel> kernel(c10::Device, const KernelSource& source) override {
    const std::lock_guard lock(mutex_);
    if (std::ranges::find(asked_for, source.text, &KernelSource::text) == asked_for.end()) asked_for.push_back(source);
    if (settings.refuses) throw Unavailable("the device has no room for a block of this kernel");
    auto& kernel = kernels_[{source.text, settings.from_ptx}];
    if (!kernel) kernel = std::make_shared<FiberKernel>(source);
    return kernel;
  }
  bool is_capturing(c10::Device) override { return settings.captures; }

 private:
  std::mutex mutex_;
  std::map<std::pair<std::string, bool>, std::shared_ptr<const prdp::gpu::Kernel>> kernels_;
};

/// What `run` raises, in words; nothing where it does not.
template <class Run>
const char* said_by(const Run& run) {
  static thread_local std::string said;
  said.clear();
  try {
    run();
  } catch (const std::exception& e) {
    said = e.what();
  }
  return said.c_str();
}

const c10::Device kCuda(c10::DeviceType::CUDA, 0);
/// A torch without CUDA knows no current device of that kind. Here, devices have streams, and threads no context.
struct CudaWithoutTorch final : c10::impl::NoOpDeviceGuardImpl<c10::DeviceType::CUDA> {
  c10::Stream getStream(c10::Device device) const noexcept override {
    return c10::Stream(c10::Stream::UNSAFE, device, 7);
  }
  void* getStreamNativeHandle(const c10::Stream stream) const override {
    return reinterpret_cast<void*>(100 * stream.device_index() + stream.id());
  }
};
void register_cuda() {
  static auto* const guard = new CudaWithoutTorch;  // outlives every thread
  static const c10::impl::DeviceGuardImplRegistrar registered(c10::DeviceType::CUDA, guard);
}

}  // namespace

/// From here on, kernels serve tensors of the CPU; and no longer.
extern "C" void prdp_fibers_begin(int64_t block_memory, int64_t cells_of_block, int64_t threads, int order,
                                  int left_out, bool poisons, bool captures, int64_t most_blocks, bool from_ptx) {
  static auto* runtime = new FiberRuntime;
  settings = {.limits = {block_memory, cells_of_block, threads, most_blocks},
              .order = order,
              .left_out = left_out,
              .poisons = poisons,
              .captures = captures,
              .refuses = false,
              .from_ptx = from_ptx};
  asked_for.clear();
  prdp::gpu::set_runtime(c10::DeviceType::CPU, runtime);
}
/// Until they begin again, none can be made.
extern "C" void prdp_fibers_refuse() { settings.refuses = true; }
/// How many kernels were asked for since then.
extern "C" int64_t prdp_fibers_kernels() { return std::ssize(asked_for); }
extern "C" const char* prdp_text_of(int64_t kernel) { return asked_for.at(static_cast<size_t>(kernel)).text.c_str(); }
/// Bytes that a block is launched with, beside what its text declares.
extern "C" int64_t prdp_block_memory_of(int64_t kernel) {
  return asked_for.at(static_cast<size_t>(kernel)).block_memory;
}
/// Compiles a text for devices of this compute capability by NVRTC. Returns what went wrong, or nothing; the length of
/// the binary goes to `size`.
extern "C" const char* prdp_compile(const char* text, int capability, int64_t* size) {
  return said_by([&] { *size = std::ssize(prdp::gpu::nvrtc::compile(text, capability)); });
}
/// What the compiler says of it.
extern "C" const char* prdp_resources_of(const char* text, int capability) {
  static std::string found;
  const char* const error = said_by([&] { found = prdp::gpu::nvrtc::resources(text, capability); });
  return *error ? error : found.c_str();
}
/// Why CUDA cannot be used here; nothing where it can.
extern "C" const char* prdp_why_no_cuda() {
  return said_by([] { prdp::gpu::cuda_runtime().limits(kCuda); });
}
/// Why CUDA makes no kernel of this text here, at the last of so many tries.
extern "C" const char* prdp_why_no_kernel_of_cuda(const char* text, int64_t tries) {
  register_cuda();
  const char* said = "";
  for (int64_t k = 0; k < tries; ++k)
    said = said_by([&] { prdp::gpu::cuda_runtime().kernel(kCuda, {text, 32, 0, 1}); });
  return said;
}
/// Launches a kernel of this text, for two teams of so many blocks, in a thread of its own. Returns what went wrong.
extern "C" const char* prdp_launch_on_cuda(const char* text, int64_t blocks, int64_t device) {
  register_cuda();
  static std::string said;
  std::thread([&] {
    said = said_by([&] {
      const c10::Device cuda(c10::DeviceType::CUDA, static_cast<c10::DeviceIndex>(device));
      const int argument = 42;
      prdp::gpu::cuda_runtime().kernel(cuda, {text, 64, 60000, blocks})->launch(2, &argument);
    });
  }).join();
  return said.c_str();
}
/// Why a sample of this size has no kernel.
extern "C" const char* prdp_why_too_large(int64_t unknowns) {
  return said_by([&] {
    prdp::gpu::solve_kernel({"A"}, false, prdp::CG{}, at::empty({1}).expand({1, unknowns}),
                            {96 << 10, 16384, 1024, 132});
  });
}
/// How many kernels were launched so far.
extern "C" int64_t prdp_fibers_launches() { return launches; }
extern "C" void prdp_fibers_end() { prdp::gpu::set_runtime(c10::DeviceType::CPU, nullptr); }
