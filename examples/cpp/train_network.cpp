/// Trains a network through a heat step in C++: what the network makes of u0 shall, after one step of the solver,
/// be where two steps lead. PRDP begins with one iteration per solve and adds more as the error stops falling.
#include <prdp/prdp.h>
#include <prdp_experiments/networks/mlp.h>
#include <torch/optim/adam.h>

#include <iostream>

namespace {

void train() {
  constexpr int64_t kUnknowns = 30, kEpochs = 60, kUpdates = 10;
  at::manual_seed(0);
  auto exact = prdp::Heat({kUnknowns}, /*nu=*/1e-3, /*dt=*/1.0, prdp::Direct{});
  auto heat = prdp::Heat({kUnknowns}, /*nu=*/1e-3, /*dt=*/1.0, prdp::Jacobi{.max_iter = 1});
  auto controller = prdp::PRDPController({.tau_step = 0.98, .delta = 2, .window = 3, .increment = 4});
  const auto u0 = at::randn({50, 1, kUnknowns});
  const auto wanted = exact(exact(u0));

  prdp::MLP network(kUnknowns, std::vector<int64_t>{64});
  torch::optim::Adam optimiser(network->parameters(), torch::optim::AdamOptions(3e-3));
  for (int epoch = 0; epoch < kEpochs; ++epoch) {
    for (int update = 0; update < kUpdates; ++update) {
      optimiser.zero_grad();
      const auto error = (heat(network->forward(u0)) - wanted).square().mean();
      error.backward();
      optimiser.step();
    }
    // The metric is measured with converged steps, so that it sees what too few iterations cost.
    const auto metric = ((exact(network->forward(u0)) - wanted).norm() / wanted.norm()).item<double>();
    if (epoch % 10 == 0 || epoch + 1 == kEpochs)
      std::cout << "epoch " << epoch << ": error " << metric << ", K = " << heat.max_iter() << '\n';
    if (controller.step(metric, prdp::last_solves({&heat}))) prdp::set_budget(heat, controller.budget());
  }
  if (const auto warning = controller.warning()) std::cout << *warning << '\n';
}

}  // namespace

int main() {
  try {
    train();
  } catch (const c10::Error& error) {
    std::cerr << "train_network: " << error.what_without_backtrace() << '\n';
    return 1;
  }
}
