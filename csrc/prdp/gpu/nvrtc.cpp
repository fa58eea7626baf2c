#include "prdp/gpu/nvrtc.h"

#include <algorithm>
#include <cstdlib>
#include <filesystem>

#include "prdp/gpu/cuda_driver.h"
#include "prdp/gpu/embedded_headers.h"
#include "prdp/gpu/kernel_cache.h"
#include "prdp/gpu/shared_library.h"

namespace prdp::gpu::nvrtc {

namespace {

namespace fs = std::filesystem;

struct Functions {
  int (*version)(int* major, int* minor);
  int (*create)(void** program, const char* text, const char* name, int headers, const char* const* texts,
                const char* const* names);
  int (*compile)(void* program, int options, const char* const*);
  int (*destroy)(void** program);
  int (*log_size)(void* program, size_t*);
  int (*log)(void* program, char*);
  int (*cubin_size)(void* program, size_t*);
  int (*cubin)(void* program, char*);
  int (*ptx_size)(void* program, size_t*);
  int (*ptx)(void* program, char*);
  int (*count_architectures)(int*);
  int (*architectures)(int*);
};

/// The folder of the library that this function is in.
fs::path folder_of(const void* function) {
  Dl_info found;
  return dladdr(function, &found) && found.dli_fname ? fs::path(found.dli_fname).parent_path() : fs::path();
}

/// Whether a driver is here that may not load what CUDA 13 compiles.
bool is_driver_of_cuda_12() {
  try {
    const auto& driver = CudaDriver::get();
    int version = 0;
    driver.check(driver.version(&version), "no version");
    return version < 13000;  // 1000 major + 10 minor
  } catch (const Unavailable&) {  // none: nothing that is compiled runs here
    return false;
  }
}

/// Where NVRTC may be: the one that torch has loaded, beside torch's wheel, conda's, or the system's. That of the
/// driver's version comes first.
std::vector<std::string> names() {
  std::vector<std::string> all;
  if (const char* named = std::getenv("PRDP_NVRTC")) return {named};
  const auto packages = folder_of(reinterpret_cast<const void*>(&at::globalContext)).parent_path().parent_path();
  const bool is_older = is_driver_of_cuda_12();
  for (const char* version : {is_older ? "12" : "13", is_older ? "13" : "12"}) {
    const std::string name = std::string("libnvrtc.so.") + version;
    all.push_back(name);
    for (const char* folder : {"cu13", "cuda_nvrtc"}) all.push_back(packages / "nvidia" / folder / "lib" / name);
    all.push_back(packages.parent_path().parent_path() / name);  // lib/python3.11/site-packages
    all.push_back("/usr/local/cuda/lib64/" + name);
  }
  return all;
}

/// NVRTC opens it by its bare name, which fails where its folder is on no path.
void load_builtins(const fs::path& folder) {
  std::error_code none;
  for (const auto& file : fs::directory_iterator(folder, none))
    if (const auto name = file.path().filename().string();
        name.starts_with("libnvrtc-builtins.so") || name.starts_with("libnvrtc-builtins-"))
      dlopen(file.path().c_str(), RTLD_NOW | RTLD_GLOBAL);
}

const Functions& functions() {
  static const Functions all = [] {
    const SharedLibrary library(names());
    if (!library)
      throw Unavailable("there is no NVRTC: pip install nvidia-cuda-nvrtc, or name libnvrtc.so in PRDP_NVRTC");
    Functions f{};
    library.bind(f.version, "nvrtcVersion");
    library.bind(f.create, "nvrtcCreateProgram");
    library.bind(f.compile, "nvrtcCompileProgram");
    library.bind(f.destroy, "nvrtcDestroyProgram");
    library.bind(f.log_size, "nvrtcGetProgramLogSize");
    library.bind(f.log, "nvrtcGetProgramLog");
    library.bind(f.cubin_size, "nvrtcGetCUBINSize");
    library.bind(f.cubin, "nvrtcGetCUBIN");
    library.bind(f.ptx_size, "nvrtcGetPTXSize");
    library.bind(f.ptx, "nvrtcGetPTX");
    library.bind(f.count_architectures, "nvrtcGetNumSupportedArchs");
    library.bind(f.architectures, "nvrtcGetSupportedArchs");
    load_builtins(folder_of(reinterpret_cast<const void*>(f.version)));
    return f;
  }();
  return all;
}

/// "sm_90"; "compute_90", of the newest that NVRTC knows, for a device that is newer.
std::string architecture(int capability) {
  int count = 0;
  functions().count_architectures(&count);
  std::vector<int> known(static_cast<size_t>(count));
  functions().architectures(known.data());
  if (std::find(known.begin(), known.end(), capability) != known.end()) return "sm_" + std::to_string(capability);
  int newest = 0;
  for (const int one : known)
    if (one <= capability) newest = std::max(newest, one);
  if (newest == 0)
    throw Unavailable("NVRTC knows no device of compute capability " + std::to_string(capability / 10) + "." +
                      std::to_string(capability % 10));
  return "compute_" + std::to_string(newest);
}

using Getter = int (*)(void*, char*);
using Sizer = int (*)(void*, size_t*);
std::string text_of(void* program, Sizer size_of, Getter get) {
  size_t size = 0;
  if (size_of(program, &size) != 0) return {};
  std::string text(size, '\0');
  return get(program, text.data()) == 0 ? text : std::string();
}

struct Compiled {
  std::string binary, log;
};

Compiled compile_now(const std::string& text, const std::vector<std::string>& options, bool to_cubin) {
  const auto& f = functions();
  std::vector<const char*> header_names, header_texts, flags;
  for (const auto& source : sources()) {
    header_names.push_back(source.name);
    header_texts.push_back(source.text);
  }
  for (const auto& option : options) flags.push_back(option.c_str());
  void* program = nullptr;
  if (f.create(&program, text.c_str(), "prdp.cu", static_cast<int>(header_names.size()), header_texts.data(),
               header_names.data()) != 0)
    throw Unavailable("NVRTC does not start");
  const bool failed = f.compile(program, static_cast<int>(flags.size()), flags.data()) != 0;
  const Compiled result{to_cubin ? text_of(program, f.cubin_size, f.cubin) : text_of(program, f.ptx_size, f.ptx),
                        text_of(program, f.log_size, f.log)};
  f.destroy(&program);
  constexpr size_t enough = 1500;
  if (failed) throw Unavailable("NVRTC does not compile the kernel: " + result.log.substr(0, enough));
  return result;
}

std::vector<std::string> options_for(const std::string& arch) {
  // Without contraction, the bits are those that the fibers of the tests give on a CPU.
  return {"--gpu-architecture=" + arch, "--std=c++20", "--device-as-default-execution-space", "--fmad=false"};
}

}  // namespace

std::string compile(const std::string& text, int capability) {
  const auto arch = architecture(capability);
  const auto options = options_for(arch);
  int major = 0, minor = 0;
  functions().version(&major, &minor);
  std::string everything = text + std::to_string(major) + "." + std::to_string(minor);
  for (const auto& option : options) everything += "\n" + option;
  for (const auto& source : sources()) everything += source.text;
  const auto key = kernel_cache::key_of(everything);
  if (auto kept = kernel_cache::find(key)) return *std::move(kept);
  auto binary = compile_now(text, options, arch.starts_with("sm_")).binary;
  kernel_cache::keep(key, binary);
  return binary;  // what was compiled, not what lies there
}

std::string resources(const std::string& text, int capability) {
  const auto arch = architecture(capability);
  auto options = options_for(arch);
  options.emplace_back("--ptxas-options=-v");
  return compile_now(text, options, arch.starts_with("sm_")).log;
}

}  // namespace prdp::gpu::nvrtc
