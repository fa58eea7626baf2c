#include "prdp_experiments/files/tensor_map.h"

#include <torch/csrc/jit/serialization/pickle.h>

namespace prdp {

std::string pack(const TensorMap& tensors) {
  std::vector<c10::IValue> entries;
  for (const auto& [name, tensor] : tensors) {
    entries.emplace_back(name);
    entries.emplace_back(tensor.detach());
  }
  const auto bytes = torch::jit::pickle_save(c10::ivalue::Tuple::create(std::move(entries)));
  return {bytes.data(), bytes.size()};
}

const at::Tensor& entry(const TensorMap& tensors, const std::string& name, at::ScalarType dtype,
                        at::IntArrayRef sizes) {
  const auto found = tensors.find(name);
  TORCH_CHECK_VALUE(found != tensors.end(), "no tensor '", name, "'");
  const auto& tensor = found->second;
  TORCH_CHECK_VALUE(tensor.defined() && tensor.scalar_type() == dtype && tensor.sizes() == sizes, "tensor '", name,
                    "' is not ", dtype, " of sizes ", sizes);
  return tensor;
}

}  // namespace prdp
