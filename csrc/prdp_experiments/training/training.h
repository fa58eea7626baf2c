#pragma once
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "prdp/controller/controller.h"
#include "prdp_experiments/data/data.h"
#include "prdp_experiments/files/checkpoint.h"
#include "prdp_experiments/scenes/scene.h"
#include "prdp_experiments/training/curves.h"

/// The C++ trainer: the same loops as prdp_torch/experiments/training.py.
namespace prdp::train {

/// How a training chooses K and the tolerance.
struct Refinement {
  std::string label;  // "auto", "prdp", "constant_25", "schedule_25_6", "direct"
  std::function<std::unique_ptr<Controller>()> controller;
  bool direct = false;
  bool watches_error = false;  // the controller is given the relative error, not the metric
  std::optional<Start> start{};  // in place of the scene's
};
/// Fits every scene without settings. docs/refinement.md explains it.
Refinement automatic();
Refinement prdp(const Scene& scene);
Refinement schedule(int64_t start, int64_t step, int64_t maximum);
Refinement constant(int64_t k);
Refinement direct();

/// Called after each interval with (how many are done, the metric, K), and where a checkpoint is gone on
/// from.
using OnInterval = std::function<void(int64_t, double, int64_t)>;

/// Trains the scene once; `seed` is that of the network's weights and of the shuffling, or of a field's noise. A
/// network begins with the weights of a file, as load_weights() takes them, where `weights` is not empty. Goes on from
/// the checkpoint where there is one, and keeps itself there whenever one is due after an interval.
Curves train(const Scene& scene, const Refinement& refinement, int64_t seed, const std::filesystem::path& weights,
             const OnInterval& on_interval, Checkpoint& checkpoint, const OnProgress& on_data = {});

}  // namespace prdp::train
