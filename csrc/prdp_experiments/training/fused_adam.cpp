#include "prdp_experiments/training/fused_adam.h"

#include <ATen/ATen.h>

namespace prdp::train {

torch::Tensor FusedAdam::step(LossClosure closure) {
  const at::NoGradGuard no_grad;
  at::Tensor loss;
  if (closure) {
    const at::AutoGradMode enable_grad(true);
    loss = closure();
  }
  for (auto& group : param_groups()) {
    std::vector<at::Tensor> parameters, gradients, means, squares, steps;
    for (const auto& parameter : group.params()) {
      if (!parameter.grad().defined()) continue;
      auto& slot = state_[parameter.unsafeGetTensorImpl()];
      if (!slot) {
        auto fresh = std::make_unique<torch::optim::AdamParamState>();
        fresh->exp_avg(at::zeros_like(parameter));
        fresh->exp_avg_sq(at::zeros_like(parameter));
        slot = std::move(fresh);
      }
      auto& state = static_cast<torch::optim::AdamParamState&>(*slot);
      state.step(state.step() + 1);
      parameters.push_back(parameter);
      gradients.push_back(parameter.grad());
      means.push_back(state.exp_avg());
      squares.push_back(state.exp_avg_sq());
      steps.push_back(at::full({}, static_cast<double>(state.step()), parameter.options().dtype(at::kFloat)));
    }
    const auto& options = static_cast<const torch::optim::AdamOptions&>(group.options());
    const auto [beta1, beta2] = options.betas();
    if (!parameters.empty())
      at::_fused_adam_(parameters, gradients, means, squares, /*max_exp_avg_sqs=*/{}, steps, options.lr(), beta1, beta2,
                       /*weight_decay=*/0.0, options.eps(), /*amsgrad=*/false, /*maximize=*/false);
  }
  return loss;
}

namespace {

std::string name_of(size_t parameter, const char* part) {
  return "optimiser." + std::to_string(parameter) + "." + part;
}

}  // namespace

void FusedAdam::save(TensorMap& tensors) const {
  const auto& parameters = param_groups()[0].params();
  for (size_t i = 0; i < parameters.size(); ++i) {
    const auto found = state_.find(parameters[i].unsafeGetTensorImpl());
    TORCH_INTERNAL_ASSERT(found != state_.end());  // every update has a gradient for every parameter
    const auto& state = static_cast<const torch::optim::AdamParamState&>(*found->second);
    tensors[name_of(i, "step")] = at::tensor({state.step()}, at::kLong);
    tensors[name_of(i, "mean")] = state.exp_avg();
    tensors[name_of(i, "square")] = state.exp_avg_sq();
  }
}

void FusedAdam::load(Saved& saved, int64_t updates) {
  const auto& parameters = param_groups()[0].params();
  for (size_t i = 0; i < parameters.size(); ++i) {
    const auto dtype = parameters[i].scalar_type();
    const auto device = parameters[i].device();
    const auto sizes = parameters[i].sizes();
    auto state = std::make_unique<torch::optim::AdamParamState>();
    const Range steps{.least = static_cast<double>(updates), .most = static_cast<double>(updates)};
    state->step(saved.list<int64_t>(name_of(i, "step"), 1, steps)[0]);
    state->exp_avg(saved.take(name_of(i, "mean"), dtype, sizes).contiguous().to(device));
    state->exp_avg_sq(saved.take(name_of(i, "square"), dtype, sizes, {.least = 0.0}).contiguous().to(device));
    state_[parameters[i].unsafeGetTensorImpl()] = std::move(state);
  }
}

}  // namespace prdp::train
