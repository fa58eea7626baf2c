#include "prdp_experiments/training/loss.h"

#include <algorithm>
#include <cstdio>

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

std::string why_lost(double first, double last) {
  constexpr double most = 10;  // times its own size, and times that of before
  if (last <= most * std::max(1.0, first)) return {};
  char text[128];
  std::snprintf(text, sizeof text, "its relative error is %.1e at the end, and was %.1e before the first interval",
                last, first);
  return text;
}

}  // namespace prdp
