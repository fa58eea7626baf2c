#pragma once
#include <torch/nn/module.h>

#include <filesystem>
#include <string>

namespace prdp {

/// A network's parameters by name, as the bytes of a file that `torch.load(path, weights_only=True)` reads in Python:
/// the `state_dict` of the network's twin there.
std::string pack_weights(const torch::nn::Module& network);
/// The inverse, also for files that `torch.save(dict(network.state_dict()), path)` has written in Python. The bytes make
/// tensors and nothing else: no code in them is run. Raises ValueError, and changes nothing, for other bytes and for
/// tensors that do not have the names, sizes and dtype of the network's.
void unpack_weights(const std::string& bytes, torch::nn::Module& network);

/// The same with a file. Raise ValueError, naming it, where it cannot be written or read.
void save_weights(const std::filesystem::path& path, const torch::nn::Module& network);
void load_weights(const std::filesystem::path& path, torch::nn::Module& network);

}  // namespace prdp
