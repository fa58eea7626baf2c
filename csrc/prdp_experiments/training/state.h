#pragma once
#include <torch/nn/module.h>

#include "prdp_experiments/files/tensor_map.h"
#include "prdp_experiments/training/fused_adam.h"
#include "prdp_experiments/training/training.h"

/// The content of a checkpoint of the C++ trainer. It has only tensors, also for numbers, so no file can contain code.
/// Loading raises ValueError for tensors that are missing or have other sizes.
namespace prdp::train {

/// The part of every training: the curves so far and the state of the controller.
void save(TensorMap& tensors, const Curves& curves, const Controller& controller);
void load(const TensorMap& tensors, Curves& curves, Controller& controller);

/// The additional part of a network; `shuffling` is the generator that orders its samples.
void save(TensorMap& tensors, const torch::nn::Module& network, const FusedAdam& optimiser,
          const at::Generator& shuffling);
void load(const TensorMap& tensors, torch::nn::Module& network, FusedAdam& optimiser, at::Generator& shuffling);

}  // namespace prdp::train
