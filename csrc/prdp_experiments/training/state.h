#pragma once
#include <torch/nn/module.h>

#include "prdp_experiments/files/saved.h"
#include "prdp_experiments/training/fused_adam.h"

/// What the checkpoint of a network's training holds beside its progress. Loading raises ValueError for tensors that
/// are missing or are not of this network after so many updates.
namespace prdp::train {

/// `shuffling` is the generator that orders the samples.
void save(TensorMap& tensors, const torch::nn::Module& network, const FusedAdam& optimiser,
          const at::Generator& shuffling);
void load(Saved& saved, int64_t updates, torch::nn::Module& network, FusedAdam& optimiser, at::Generator& shuffling);

}  // namespace prdp::train
