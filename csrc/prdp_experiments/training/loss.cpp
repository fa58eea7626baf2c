#include "prdp_experiments/training/loss.h"

namespace prdp {

at::Tensor normalised_mse(const at::Tensor& u, const at::Tensor& reference) {
  TORCH_CHECK_VALUE(u.sizes() == reference.sizes(), "normalised_mse: u has shape ", u.sizes(),
                    " but the reference has ", reference.sizes());
  const auto error = (u - reference).flatten(1).square().sum(1);
  return (error / reference.flatten(1).square().sum(1)).mean();
}

at::Tensor loss(std::string_view kind, const at::Tensor& u, const at::Tensor& reference) {
  if (kind == "nmse") return normalised_mse(u, reference);
  TORCH_CHECK_VALUE(kind == "mse", "loss: unknown name '", kind, "'; allowed: nmse, mse");
  return at::mse_loss(u, reference);
}

at::Tensor half_mse(const at::Tensor& u, const at::Tensor& reference) { return 0.5 * at::mse_loss(u, reference); }

at::Tensor relative_error(const at::Tensor& theta, const at::Tensor& reference) {
  return (theta - reference).norm() / reference.norm();
}

}  // namespace prdp
