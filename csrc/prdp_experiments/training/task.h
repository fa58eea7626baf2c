#pragma once
#include <ATen/ATen.h>

#include <functional>
#include <optional>

#include "prdp_experiments/files/saved.h"

namespace prdp::train {

/// Called after each update with its loss and the numbers of its samples in the data set, if they have any.
using OnUpdate = std::function<void(double loss, const std::optional<at::Tensor>& samples)>;

/// What a task supplies: the updates of one interval, numbered from `update`, each of them reported;
/// the metric; the relative error of what is trained, as far as a user knows it, given the metric; and all
/// that the updates change, to and from tensors. Loading raises ValueError for tensors of another task, or of another
/// number of updates.
struct Task {
  std::function<void(int64_t update, const OnUpdate& on_update)> updates;
  std::function<double()> metric;
  std::function<double(double metric)> error;
  std::function<void(TensorMap&)> save;
  std::function<void(Saved&, int64_t updates)> load;
  int64_t updates_per_interval = 1;
};

}  // namespace prdp::train
