#include "prdp_experiments/training/state.h"

#include <ATen/CPUGeneratorImpl.h>

namespace prdp::train {

void save(TensorMap& tensors, const torch::nn::Module& network, const FusedAdam& optimiser,
          const at::Generator& shuffling) {
  for (const auto& weight : network.named_parameters()) tensors["network." + weight.key()] = weight.value();
  optimiser.save(tensors);
  tensors["shuffling"] = shuffling.get_state();
  tensors["random"] = at::detail::getDefaultCPUGenerator().get_state();
}

void load(Saved& saved, int64_t updates, torch::nn::Module& network, FusedAdam& optimiser, at::Generator& shuffling) {
  const torch::NoGradGuard no_grad;
  for (auto& weight : network.named_parameters()) {
    auto& now = weight.value();
    now.copy_(saved.take("network." + weight.key(), now.scalar_type(), now.sizes()));
  }
  optimiser.load(saved, updates);
  saved.restore("shuffling", shuffling);
  saved.restore("random", at::detail::getDefaultCPUGenerator());
}

}  // namespace prdp::train
