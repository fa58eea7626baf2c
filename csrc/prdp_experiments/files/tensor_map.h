#pragma once
#include <ATen/ATen.h>

#include <map>
#include <string>
#include <string_view>

namespace prdp {

/// Tensors by name: what a file of data or of the C++ trainer's state holds.
using TensorMap = std::map<std::string, at::Tensor>;

/// The tensors as bytes, which do not say on which device they were.
std::string pack(const TensorMap& tensors);
/// The tensors in such bytes, or in those of a dict or a state_dict that torch.save has written in Python. No code in
/// them is run, and memory is taken in proportion to their length. Raises ValueError for other bytes.
TensorMap unpack(std::string_view bytes);

}  // namespace prdp
