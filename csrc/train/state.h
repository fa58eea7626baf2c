#pragma once
#include <torch/nn/module.h>

#include "fused_adam.h"
#include "prdp/scenes/tensor_map.h"
#include "training.h"

/// What is in a checkpoint of the C++ trainer: tensors and nothing else, numbers included, so that no file can bring
/// code along. Loading raises ValueError for tensors that are missing or of other sizes.
namespace prdp::train {

/// What every training has: the curves so far and what the controller knows.
void save(TensorMap& tensors, const Curves& curves, const Controller& controller);
void load(const TensorMap& tensors, Curves& curves, Controller& controller);

/// What that of a network has beside; `shuffling` is the generator that orders its samples.
void save(TensorMap& tensors, const torch::nn::Module& network, const FusedAdam& optimiser,
          const at::Generator& shuffling);
void load(const TensorMap& tensors, torch::nn::Module& network, FusedAdam& optimiser, at::Generator& shuffling);

}  // namespace prdp::train
