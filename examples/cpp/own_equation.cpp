/// An equation of one's own, u_t = ∇·(κ ∇u) + u - u³ without flux at the ends, and its field κ found from measurements.
#include <prdp/prdp.h>
#include <torch/torch.h>

#include <iostream>

namespace {

constexpr double kDt = 0.1;

/// Implicit in the diffusion, explicit in the reaction. κ (1, N) is read anew in every step.
prdp::ImplicitStep make_step(const std::function<at::Tensor()>& kappa) {
  const auto diffusion = [kappa](const at::Tensor&) {
    return prdp::diffusion(kappa(), 1 / kDt, {{prdp::Side::kFlux, prdp::Side::kFlux}});
  };
  const auto rhs = [](const at::Tensor& u) { return u / kDt + u - u.pow(3); };
  return {diffusion, rhs, prdp::CG{.max_iter = 100, .rtol = 1e-5}};
}

}  // namespace

int main() {
  torch::manual_seed(0);
  const auto x = (torch::arange(32) + 0.5) / 32;  // centres of the cells
  const auto kappa = (0.02 * (1 + 0.8 * torch::sin(6 * x))).unsqueeze(0);
  const auto u0 = torch::randn({16, 1, 32});
  const auto measured = make_step([=] { return kappa; }).rollout(u0, 5);

  auto log_kappa = torch::full({1, 32}, std::log(0.02)).requires_grad_();
  auto step = make_step([=] { return log_kappa.exp(); });
  torch::optim::Adam optimiser({log_kappa}, 0.05);
  for (int update = 0; update <= 100; ++update) {
    const auto loss = (step.rollout(u0, 5) - measured).square().mean();
    const auto error = ((log_kappa.exp() - kappa).norm() / kappa.norm()).item<double>();
    if (update % 50 == 0) std::cout << "loss " << loss.item<double>() << ", error of kappa " << error << '\n';
    optimiser.zero_grad();
    loss.backward();
    optimiser.step();
  }
}
