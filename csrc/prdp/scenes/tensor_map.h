#pragma once
#include <ATen/ATen.h>

#include <map>
#include <string>

namespace prdp {

/// Tensors by name: what a file of data or of the C++ trainer's state holds.
using TensorMap = std::map<std::string, at::Tensor>;

/// The tensors as bytes.
std::string pack(const TensorMap& tensors);
/// The inverse of `pack`, whose bytes make tensors and nothing else: no code in them is run. Raises ValueError for
/// other bytes.
TensorMap unpack(const std::string& bytes);

/// The tensor of this name. Raises ValueError if there is none of this dtype and these sizes.
const at::Tensor& entry(const TensorMap& tensors, const std::string& name, at::ScalarType dtype, at::IntArrayRef sizes);

}  // namespace prdp
