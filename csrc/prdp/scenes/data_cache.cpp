#include "prdp/scenes/data_cache.h"

#include <torch/csrc/jit/serialization/pickle.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <iomanip>
#include <iterator>
#include <sstream>

#include "prdp/scenes/files.h"

namespace prdp {

namespace {

namespace fs = std::filesystem;

constexpr int kFormat = 1;

/// All that the data depend on, in words.
std::string settings_of(const Scene& scene) {
  const auto& p = scene.physics;
  const auto& d = scene.data;
  std::ostringstream text;
  text << std::setprecision(17) << "prdp data " << kFormat << ": " << p.equation << ", shape "
       << at::IntArrayRef(p.shape) << ", reference_shape " << at::IntArrayRef(d.reference_shape) << ", nu " << p.nu
       << ", dt " << p.dt << ", train " << d.train << ", valid " << d.valid << ", valid_steps " << d.valid_steps
       << ", seed " << d.seed << ", " << scene.dtype;
  if (scene.task == Scene::Task::kEmulator) text << ", modes " << d.modes;
  return text.str();
}

fs::path cache_folder() {
  const char *chosen = std::getenv("PRDP_CACHE"), *home = std::getenv("HOME");
  const bool given = chosen && *chosen;
  TORCH_CHECK_VALUE(given || home, "data: set PRDP_CACHE to a folder for the data set; there is no HOME");
  const auto folder = given ? fs::path(chosen) : fs::path(home) / ".cache" / "prdp_torch";
  std::error_code error;
  fs::create_directories(folder, error);
  TORCH_CHECK_VALUE(!error && access(folder.c_str(), W_OK) == 0, "data: cannot write to '", folder.string(),
                    "'; set PRDP_CACHE to a folder for the data set");
  return folder;
}

std::vector<at::Tensor> tensors_of(const Dataset& d) {
  std::vector<at::Tensor> all{d.train_start, d.train_end, d.valid_start, d.valid_end};
  if (d.train_first.defined()) all.push_back(d.train_first);
  return all;
}

void write(const fs::path& path, const std::string& settings, const Dataset& data) {
  const auto bytes = torch::jit::pickle_save(
      c10::ivalue::Tuple::create({settings, c10::List<at::Tensor>(at::ArrayRef<at::Tensor>(tensors_of(data)))}));
  // Another process may be writing the same.
  write_whole(path, {bytes.data(), bytes.size()}, std::to_string(getpid()) + ".part");
}

bool fits(const Dataset& data, const Scene& scene) {
  const auto holds = [&](int64_t samples, const at::Tensor& u) {
    std::vector<int64_t> sizes{samples, scene.physics.channels()};
    sizes.insert(sizes.end(), scene.physics.shape.begin(), scene.physics.shape.end());
    return u.scalar_type() == scene.dtype && u.sizes().equals(sizes);
  };
  const int64_t train = scene.data.train, valid = scene.data.valid;
  const bool first = scene.task != Scene::Task::kCorrector || holds(train, data.train_first);
  return first && holds(train, data.train_start) && holds(train, data.train_end) &&
         holds(valid, data.valid_start) && holds(valid, data.valid_end);
}

Dataset read(const fs::path& path, const std::string& settings, const Scene& scene) {
  std::ifstream file(path, std::ios::binary);
  const std::vector<char> bytes{std::istreambuf_iterator<char>(file), {}};
  std::string found;
  Dataset data;
  try {
    const auto content = torch::jit::pickle_load(bytes).toTuple();
    found = content->elements().at(0).toStringRef();
    const auto tensors = content->elements().at(1).toTensorVector();
    data = {tensors.at(0), tensors.at(1), tensors.at(2), tensors.at(3), {}};
    if (tensors.size() > 4) data.train_first = tensors[4];
  } catch (const std::exception&) {
    TORCH_CHECK_VALUE(false, "data: '", path.string(), "' is damaged; delete it, and it is made again");
  }
  TORCH_CHECK_VALUE(found == settings && fits(data, scene), "data: '", path.string(), "' holds '", found,
                    "', not '", settings, "'; delete it, and it is made again");
  return data;
}

}  // namespace

Dataset cached_dataset(const Scene& scene, const std::function<Dataset()>& make) {
  const auto settings = settings_of(scene);
  std::ostringstream name;
  name << scene.physics.equation << '-' << std::hex << std::setw(16) << std::setfill('0')
       << fingerprint(settings) << ".pt";
  const auto path = cache_folder() / name.str();
  if (fs::exists(path)) return read(path, settings, scene);
  const auto data = make();
  write(path, settings, data);
  return data;
}

}  // namespace prdp
