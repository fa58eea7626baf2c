#include "prdp_experiments/files/tensor_map.h"

#include <torch/csrc/jit/serialization/pickle.h>

namespace prdp {

std::string pack(const TensorMap& tensors) {
  std::vector<c10::IValue> entries;
  for (const auto& [name, tensor] : tensors) {
    entries.emplace_back(name);
    entries.emplace_back(tensor.detach().cpu());
  }
  const auto bytes = torch::jit::pickle_save(c10::ivalue::Tuple::create(std::move(entries)));
  return {bytes.data(), bytes.size()};
}

}  // namespace prdp
