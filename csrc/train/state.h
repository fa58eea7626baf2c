#pragma once
#include <torch/nn/module.h>
#include <torch/optim/optimizer.h>
#include <torch/serialize/archive.h>

#include "training.h"

namespace prdp::train {

using torch::serialize::InputArchive, torch::serialize::OutputArchive;

/// What every training has in its checkpoint: the curves so far and what the controller knows.
void save(OutputArchive& archive, const Curves& curves, const Controller& controller);
void load(InputArchive& archive, Curves& curves, Controller& controller);

/// What that of a network has beside; `shuffling` is the generator that orders its samples.
void save(OutputArchive& archive, const torch::nn::Module& network,
          const torch::optim::Optimizer& optimiser, const at::Generator& shuffling);
void load(InputArchive& archive, torch::nn::Module& network, torch::optim::Optimizer& optimiser,
          at::Generator& shuffling);

/// An archive as the bytes of a checkpoint, and back.
std::string bytes_of(OutputArchive& archive);
InputArchive archive_of(const std::string& bytes);

}  // namespace prdp::train
