#include <gtest/gtest.h>
#include <torch/csrc/autograd/autograd.h>

#include <cmath>

#include "helpers.h"
#include "prdp/prdp.h"

namespace {

using prdp_test::dense_laplacian;
using prdp_test::random_field;

at::Tensor viscosity() { return at::scalar_tensor(2e-3, at::kDouble).requires_grad_(); }

TEST(ImplicitStep, WithTheHeatOperatorIsHeatToTheLastBit) {
  const prdp::Solver jacobi = prdp::Jacobi{.max_iter = 4};
  for (const auto backward : {prdp::Backward::kImplicit, prdp::Backward::kUnrolled}) {
    const auto nu = viscosity();
    auto heat = prdp::Heat({9}, nu, 0.5, jacobi, backward);
    auto own = prdp::ImplicitStep({"heat", {9}, {0.5}, {nu}}, nullptr, jacobi, backward);
    auto u = random_field({9}, 2).requires_grad_();
    const auto g = at::cat({u.detach(), 2 * u.detach(), 3 * u.detach(), u.detach()}, 1).unsqueeze(2);
    const auto expected = heat.rollout(u, 3), found = own.rollout(u, 3);
    EXPECT_TRUE(at::equal(found, expected));
    const auto of_heat = torch::autograd::grad({expected}, {u, nu}, {g});
    const auto of_own = torch::autograd::grad({found}, {u, nu}, {g});
    EXPECT_TRUE(at::equal(of_own[0], of_heat[0]) && at::equal(of_own[1], of_heat[1]));
    EXPECT_TRUE(at::equal(own.info()->iterations, heat.info()->iterations));
    EXPECT_TRUE(at::equal(own.adjoint_info()->residual, heat.adjoint_info()->residual) ||
                backward == prdp::Backward::kUnrolled);  // NaN there
    EXPECT_EQ(own.adjoint_info()->iterations.sizes(), at::IntArrayRef({2, 3}));
  }
}

TEST(ImplicitStep, ARefusedSampleGivesNoNanToItsState) {
  const auto rhs = [](const at::Tensor& u) { return u.exp(); };
  const prdp::SolveOptions options{.solver = prdp::CG{.max_iter = 100}, .on_failure = prdp::OnFailure::kZeroGrad};
  auto step = prdp::ImplicitStep(
      [](const at::Tensor&) { return prdp::OperatorSpec{"heat", {8}, {0.1}, {at::scalar_tensor(1e-2)}}; }, rhs,
      options);
  const auto weight = at::ones({}, at::kDouble).requires_grad_();
  auto u = random_field({8}, 3);
  u[1] += 1e4;  // whose exponential is infinite
  step(weight * u).square().sum().backward();
  EXPECT_TRUE(std::isfinite(weight.grad().item<double>()));
  EXPECT_NE(weight.grad().item<double>(), 0.0);
  const auto status = step.info()->status;
  EXPECT_EQ(status[1].item<int64_t>(), static_cast<int64_t>(prdp::SolveStatus::kNonfiniteInput));
}

TEST(ImplicitStep, SolvesANonlinearRightHandSideWithItsGradient) {
  const auto reaction = at::scalar_tensor(0.7, at::kDouble).requires_grad_();
  auto step = prdp::ImplicitStep(
      [](const at::Tensor&) { return prdp::OperatorSpec{"heat", {8}, {0.1}, {at::scalar_tensor(1e-2)}}; },
      [&](const at::Tensor& u) { return u + 0.1 * reaction * (u - u * u * u); },
      prdp::CG{.max_iter = 100, .rtol = 1e-13});
  const auto u = random_field({8}, 2);
  const auto a = at::eye(8, at::kDouble) - 1e-3 * dense_laplacian({8});
  const auto expected = [&](double r) {
    const auto b = u + 0.1 * r * (u - u * u * u);
    return at::linalg_solve(a, b.view({2, 8}).mT()).mT().view_as(u);
  };
  const auto next = step(u);
  // at::scalar_tensor(1e-2) is a float32.
  EXPECT_LT((next - expected(0.7)).abs().max().item<double>(), 1e-8);
  EXPECT_TRUE(step.converged());
  const auto slope = torch::autograd::grad({next.sum()}, {reaction})[0].item<double>();
  EXPECT_NEAR(slope, ((expected(0.7 + 1e-5) - expected(0.7 - 1e-5)).sum() / 2e-5).item<double>(), 1e-6);
}

TEST(ImplicitStep, FailuresSayTheStepInBothDirections) {
  int steps = 0;
  auto step = prdp::ImplicitStep(
      {"heat", {5}, {0.1}, {viscosity()}}, [&](const at::Tensor& u) { return ++steps == 2 ? u / 0.0 : u; },
      prdp::Jacobi{.max_iter = 3});
  const auto message = [](const auto& call) {
    try {
      call();
    } catch (const c10::Error& error) {
      return std::string(error.what_without_backtrace());
    }
    return std::string("nothing");
  };
  const auto u = random_field({5}, 2);
  EXPECT_EQ(message([&] { step.rollout(u, 4); }).rfind("step 2 of 4: linear_solve: 2 of 2", 0), 0u);
  steps = 10;
  const auto states = step.rollout(u, 3);
  EXPECT_FALSE(step.adjoint_info());
  auto g = at::zeros_like(states);
  g[1][2].fill_(std::nan(""));
  EXPECT_EQ(message([&] { states.backward(g); }).rfind("step 2 of 3: adjoint solve: 1 of 2", 0), 0u);
}

TEST(ImplicitStep, KeepsTheBudgetAndRefusesWhatDoesNotFit) {
  auto step = prdp::ImplicitStep({"heat", {5}, {0.1}, {viscosity()}}, nullptr, prdp::Jacobi{.max_iter = 3});
  step.set_max_iter(2);
  step(random_field({5}, 2));
  EXPECT_TRUE(step.info()->iterations.eq(2).all().item<bool>());
  EXPECT_THROW(step.set_max_iter(-1), c10::ValueError);
  EXPECT_THROW(step(random_field({6}, 2)), c10::ValueError);
  EXPECT_THROW(step(at::zeros({5})), c10::ValueError);
  EXPECT_THROW(step.rollout(random_field({5}, 2), -1), c10::ValueError);
  EXPECT_THROW(prdp::ImplicitStep(nullptr, nullptr, prdp::Solver(prdp::Direct{})), c10::ValueError);
  auto shorter = prdp::ImplicitStep(
      {"heat", {5}, {0.1}, {viscosity()}}, [](const at::Tensor& u) { return u.narrow(2, 0, 4); }, prdp::Direct{});
  EXPECT_THROW(shorter(random_field({5}, 2)), c10::ValueError);
}

TEST(ImplicitStep, TakesProductsWithoutATransposeAndWithADiagonal) {
  const auto k = at::tensor({0.5, 1.5, 1.0, 2.0}, at::kDouble).requires_grad_();
  // (2 + k) v_i - v_{i-1}, without a neighbour at the first point
  const auto products =
      prdp::RegisteredProducts::make({.apply =
                                          [](const at::Tensor& v, const std::vector<at::Tensor>& t) {
                                            return (2 + t[0]) * v - at::constant_pad_nd(v, {1, 0}).narrow(1, 0, 4);
                                          },
                                      .diagonal = [](const std::vector<at::Tensor>& t) { return 2 + t[0]; }});
  auto step = prdp::ImplicitStep([&](const at::Tensor&) { return products->spec({k}); }, nullptr,
                                 prdp::Jacobi{.max_iter = 50, .rtol = 1e-14});
  const auto u = random_field({4}, 3).view({3, 4}).requires_grad_();
  const auto next = step(u);
  const auto a = at::diag(2 + k) - at::diag(at::ones({3}, at::kDouble), -1);
  const auto expected = at::linalg_solve(a, u.mT()).mT();
  EXPECT_TRUE(at::allclose(next, expected, 1e-12));
  const auto found = torch::autograd::grad({next.square().sum()}, {u, k});
  const auto truth = torch::autograd::grad({expected.square().sum()}, {u, k});
  EXPECT_TRUE(at::allclose(found[0], truth[0], 1e-11) && at::allclose(found[1], truth[1], 1e-11));
}

/// (1/2π)² of the unit domain's viscosity in a domain of side 2π.
TEST(Length, ScalesViscosityAndLoad) {
  const double side = 2 * M_PI;
  const auto u = random_field({6, 5}, 2);
  const prdp::Solver cg = prdp::CG{.max_iter = 400, .rtol = 1e-13};
  const auto difference = [](const at::Tensor& a, const at::Tensor& b) { return (a - b).abs().max().item<double>(); };
  auto heat = prdp::Heat({6, 5}, 1e-2, 0.5, cg, prdp::Backward::kImplicit, side);
  auto unit = prdp::Heat({6, 5}, 1e-2 / (side * side), 0.5, cg);
  EXPECT_LT(difference(heat(u), unit(u)), 1e-12);
  auto poisson = prdp::Poisson({6, 5}, cg, prdp::Backward::kImplicit, {side, side});
  auto of_unit = prdp::Poisson({6, 5}, cg);
  EXPECT_LT(difference(poisson(u), of_unit(u * side * side)), 1e-10);
  const auto flow = at::cat({u, u.flip(2), u}, 1);
  for (const bool pressure : {false, true}) {
    const prdp::Solver direct = prdp::Direct{};
    const auto state = pressure ? flow : flow.narrow(1, 0, 2);
    const auto step = [&](double length, double scale) -> at::Tensor {
      if (pressure)
        return prdp::NavierStokes({6, 5}, 1e-3 * scale * scale, 0.1, direct, prdp::Backward::kImplicit, 1,
                                  length)(state * scale);
      return prdp::Burgers({6, 5}, 1e-3 * scale * scale, 0.1, direct, prdp::Backward::kImplicit, 1,
                           length)(state * scale);
    };
    // Lengths and velocities by a factor and nu by its square: the same flow.
    EXPECT_LT(difference(step(side, side).narrow(1, 0, 2) / side, step(1.0, 1.0).narrow(1, 0, 2)), 1e-11);
  }
  for (const auto& bad : std::vector<prdp::Length>{0.0, -1.0, {1.0, 2.0, 3.0}, INFINITY})
    EXPECT_THROW(prdp::Heat({6, 5}, 1e-2, 0.5, cg, prdp::Backward::kImplicit, bad), c10::ValueError);
}

}  // namespace
