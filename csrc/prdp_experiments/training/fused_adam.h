#pragma once
#include <torch/optim/adam.h>

#include "prdp_experiments/files/saved.h"

namespace prdp::train {

/// torch's Adam with the state it has, updated by the fused kernel that `torch.optim.Adam(fused=True)` calls
/// in Python: one pass over the weights, where torch's C++ step takes a dozen. Without weight decay and
/// AMSGrad, which the trainers do not use.
class FusedAdam : public torch::optim::Adam {
 public:
  using Adam::Adam;
  torch::Tensor step(LossClosure closure = nullptr) override;

  /// Steps and moments of the first group's parameters, by their order, after so many updates. Loading raises
  /// ValueError for tensors that do not fit.
  void save(TensorMap& tensors) const;
  void load(Saved& saved, int64_t updates);
};

}  // namespace prdp::train
