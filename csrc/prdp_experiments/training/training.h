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

/// What a training leaves, one entry an interval: an epoch, or an update where there is no network. Costs are those of
/// all solves of an update, of which a corrector has two and a field one a step.
struct Curves {
  std::vector<double> update_loss;  // one entry an update
  std::vector<double> metric;       // starts before the first interval
  std::vector<double> error;        // as metric; the relative error that a user knows, which the tolerances follow
  std::vector<int64_t> max_iter;    // K
  std::vector<int64_t> budget;      // K times the solves, the paper's count
  // Per sample of a batch, summed over updates; the applications are those of both solves.
  std::vector<double> iterations, operator_applications, adjoint_applications;
  std::vector<double> rtol;  // of the forward solves
  std::vector<int64_t> failed;  // samples whose forward or adjoint solve failed, over the updates
  std::vector<double> seconds;
  std::string diverged;  // where and why a training was lost; its curves end there, with a metric of NaN
  std::string warning;   // what the controller says in the end
  std::string weights;   // of a network in the end, as pack_weights() makes them
};

/// Calls f(name, values) for each of them that has an entry for every interval or update.
template <class AnyCurves, class F>
void each_curve(AnyCurves& curves, const F& f) {
  f("update_loss", curves.update_loss);
  f("metric", curves.metric);
  f("error", curves.error);
  f("max_iter", curves.max_iter);
  f("budget", curves.budget);
  f("iterations", curves.iterations);
  f("operator_applications", curves.operator_applications);
  f("adjoint_applications", curves.adjoint_applications);
  f("rtol", curves.rtol);
  f("failed", curves.failed);
  f("seconds", curves.seconds);
}

/// Called after each interval with (how many are done, the metric, K), and where a checkpoint is gone on
/// from.
using OnInterval = std::function<void(int64_t, double, int64_t)>;

/// Trains the scene once; `seed` is that of the network's weights and of the shuffling, or of a field's noise. A
/// network begins with `weights`, as pack_weights() makes them, where they are not empty. Goes on from the checkpoint
/// where there is one, and keeps itself there whenever one is due after an interval.
Curves train(const Scene& scene, const Refinement& refinement, int64_t seed, const std::string& weights,
             const OnInterval& on_interval, Checkpoint& checkpoint, const OnProgress& on_data = {});

}  // namespace prdp::train
