#pragma once
#include "prdp/controller/controller.h"
#include "prdp_experiments/files/saved.h"
#include "prdp_experiments/training/curves.h"

/// What the checkpoints of every training hold, in both languages. They have only tensors, also for numbers, so no file
/// can contain code.
namespace prdp::train {

void save(TensorMap& tensors, const Curves& curves, const Controller::State& controller);

struct Progress {
  Curves curves;
  Controller::State controller;

  int64_t done() const { return static_cast<int64_t>(curves.seconds.size()); }
};
/// Raises ValueError for anything that no training with so many updates per interval can have written.
Progress load_progress(Saved& saved, int64_t updates_per_interval);

}  // namespace prdp::train
