#pragma once
#include <torch/nn/module.h>

#include <filesystem>
#include <string>

namespace prdp {

/// The parameters of a network by name, as the bytes of a file that `torch.load(path, weights_only=True)` reads in
/// Python: the `state_dict` of the same network there.
std::string pack_weights(const torch::nn::Module& network);
/// The inverse, also for files that `torch.save(network.state_dict(), path)` has written in Python. Only tensors
/// are read, and no code in the bytes is run. Raises ValueError, and changes nothing, for other bytes, for tensors
/// whose names, sizes or dtype differ from those of the network, and for values that are not finite.
void unpack_weights(const std::string& bytes, torch::nn::Module& network);

/// The same with a file. Raises ValueError, naming the file, if it cannot be read.
void load_weights(const std::filesystem::path& path, torch::nn::Module& network);

}  // namespace prdp
