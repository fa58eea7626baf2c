#include "prdp_experiments/data/darcy.h"

#include "prdp/operators/diffusion_operator.h"

namespace prdp {

OperatorSpec darcy_operator(const at::Tensor& kappa, const Scene::Physics& physics) {
  return diffusion(kappa, at::zeros({}, kappa.options()), {{Side::kZero, Side::kZero}},
                   physics.lengths.empty() ? std::vector<double>{1.0} : physics.lengths);
}

ImplicitStep darcy_step(const Scene::Physics& physics, SolveOptions options) {
  return {[physics](const at::Tensor& log_kappa) { return darcy_operator(log_kappa.squeeze(1).exp(), physics); },
          [](const at::Tensor& log_kappa) { return at::full_like(log_kappa, kDarcySource); }, std::move(options)};
}

}  // namespace prdp
