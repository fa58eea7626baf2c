#include "prdp_experiments/data/data_cache.h"

#include <unistd.h>

#include <cstdlib>
#include <filesystem>

#include "prdp_experiments/files/saved.h"
#include "prdp_experiments/files/seal.h"
#include "prdp_experiments/files/whole_files.h"

namespace prdp {

namespace {

namespace fs = std::filesystem;

constexpr int kFormat = 4;

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

TensorMap tensors_of(const Dataset& d) {
  TensorMap tensors{{"train_start", d.train_start},
                    {"train_end", d.train_end},
                    {"valid_start", d.valid_start},
                    {"valid_end", d.valid_end}};
  if (d.train_between.defined()) tensors["train_between"] = d.train_between;
  return tensors;
}

Dataset dataset_of(Saved saved, const Scene& scene) {
  const auto states = [&](const char* name, std::vector<int64_t> sizes) {
    sizes.push_back(scene.physics.channels());
    sizes.insert(sizes.end(), scene.physics.shape.begin(), scene.physics.shape.end());
    return saved.take(name, scene.dtype, sizes);
  };
  const auto [train, valid] = std::pair(scene.data.train, scene.data.valid);
  Dataset data{states("train_start", {train}),
               states("train_end", {train}),
               states("valid_start", {valid}),
               states("valid_end", {valid}),
               {}};
  if (scene.task == Scene::Task::kCorrector)
    data.train_between = states("train_between", {train, scene.data.trained_steps - 1});
  saved.finish();
  return data;
}

}  // namespace

Dataset cached_dataset(const Scene& scene, const std::function<Dataset()>& make) {
  constexpr const char *kKind = "data", *kRemedy = "it is made again";
  const auto device = device_of_data(scene);
  const auto where = device.is_cpu() ? "" : " on " + c10::DeviceTypeName(device.type(), /*lower_case=*/true);
  const auto settings = c10::str("prdp data ", kFormat, where, ": ", data_settings(scene));
  const auto path = cache_folder() / (scene.physics.equation + '-' + fingerprint(settings) + ".data");
  if (const auto found = open_sealed(path, kKind)) {
    if (!found->sealed) refuse_damaged(path, kKind, found->wrong, kRemedy);
    const auto& [of, content] = *found->sealed;
    if (of != settings) refuse_damaged(path, kKind, c10::str("it holds '", of, "', not '", settings, "'"), kRemedy);
    try {
      return dataset_of(Saved(unpack(content)), scene);
    } catch (const c10::ValueError& error) {
      refuse_damaged(path, kKind, error.what_without_backtrace(), kRemedy);
    }
  }
  const auto data = make();
  write_whole({path, seal(kKind, {settings, pack(tensors_of(data))})});
  return data;
}

}  // namespace prdp
