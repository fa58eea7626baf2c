#pragma once
#include <functional>

#include "prdp/scenes/tensor_map.h"

namespace prdp::train {

/// What a task supplies: the updates of one interval, numbered from `update` and each reporting its loss;
/// the metric; the relative error of what is trained, as far as a user knows it, given the metric; and all
/// that the updates change, to and from tensors.
struct Task {
  std::function<void(int64_t update, const std::function<void(double)>& on_update)> updates;
  std::function<double()> metric;
  std::function<double(double metric)> error;
  std::function<void(TensorMap&)> save;
  std::function<void(const TensorMap&)> load;
};

}  // namespace prdp::train
