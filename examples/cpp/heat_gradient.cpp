/// A heat step and its derivative in C++, no Python anywhere.
#include <prdp/prdp.h>

#include <iostream>

namespace {

void run() {
  auto heat = prdp::Heat({30}, /*nu=*/1e-3, /*dt=*/1.0, prdp::Jacobi{.max_iter = 5});
  const auto u0 = at::randn({4, 1, 30}).requires_grad_();
  auto controller = prdp::PRDPController({.delta = 2, .window = 1});
  for (int interval = 0; interval < 4; ++interval) {
    const auto u1 = heat(u0);
    u1.square().sum().backward();
    std::cout << "K = " << heat.max_iter() << ": residual " << heat.info()->residual[0].item<double>()
              << ", adjoint residual " << heat.adjoint_info()->residual[0].item<double>() << '\n';
    if (controller.step(/*metric=*/1.0)) heat.set_max_iter(5 * controller.max_iter());
  }
  try {
    heat(at::randn({4, 30}));  // the channel is missing: an error in words
  } catch (const c10::Error& error) {
    // what() would add the stack of calls to the sentence.
    std::cerr << "heat_gradient: " << error.what_without_backtrace() << '\n';
  }
}

}  // namespace

int main() { run(); }
