#include <gtest/gtest.h>
#include <torch/csrc/autograd/autograd.h>

#include "prdp/prdp.h"

namespace {

prdp::FlowSettings channel(const at::Tensor& inflow) {
  auto obstacle = at::zeros({8, 12}, at::kBool);
  obstacle.slice(0, 3, 5).slice(1, 4, 6).fill_(true);
  return {.boundary = {prdp::FlowBoundary::kWall, prdp::FlowBoundary::kOpen},
          .length = {1.0, 1.5},
          .obstacle = obstacle,
          .inflow = inflow};
}

TEST(Flow, GradientForTheInflowIsThatOfDifferences) {
  const auto inflow = at::tensor({0.5, 0.1}, at::kDouble).requires_grad_();
  const auto solver = prdp::CG{200, 1e-13, prdp::Preconditioner::multigrid()};
  const auto energy = [&](const at::Tensor& velocity) {
    prdp::Flow flow({8, 12}, /*nu=*/0.01, /*dt=*/0.02, channel(velocity), solver);
    return flow.rollout(at::zeros({1, 2, 8, 12}, at::kDouble), 5).select(1, 5).square().sum();
  };
  const auto gradient = torch::autograd::grad({energy(inflow)}, {inflow})[0];
  constexpr double step = 1e-5;
  for (int64_t i = 0; i < 2; ++i) {
    const auto away = at::zeros({2}, at::kDouble);
    away[i] = step;
    const auto plain = inflow.detach();
    const double difference = (energy(plain + away) - energy(plain - away)).item<double>() / (2 * step);
    EXPECT_NEAR(gradient[i].item<double>(), difference, 1e-6 * std::abs(difference) + 1e-9);
  }
}

TEST(Flow, StatesHaveNoDivergenceAndNoVelocityOnTheObstacle) {
  prdp::Flow flow({8, 12}, 0.01, 0.02, channel(at::tensor({0.5, 0.0}, at::kDouble)));
  const auto u = flow.rollout(at::zeros({2, 2, 8, 12}, at::kDouble), 10).select(1, 10);
  EXPECT_LT(flow.divergence(u).abs().max().item<double>(), 1e-4);
  EXPECT_EQ(u.select(1, 0).slice(1, 3, 5).slice(2, 4, 7).abs().max().item<double>(), 0.0);
  EXPECT_GT(u.select(1, 0).select(2, 0).min().item<double>(), 0.49);
  EXPECT_TRUE(flow.converged());
  EXPECT_EQ(flow.info()->iterations.sizes(), at::IntArrayRef({2, 10}));
  const auto [next, pressure] = flow.step_and_pressure(u);
  EXPECT_EQ(pressure.sizes(), at::IntArrayRef({2, 1, 8, 12}));
  EXPECT_TRUE(at::equal(pressure, flow.pressure(u)) && at::equal(next, flow(u)));
}

TEST(Flow, CouetteFlowStaysAndTheLidHasItsGradient) {
  const auto lid = at::tensor({0.7, 0.0}, at::kDouble).requires_grad_();
  prdp::Flow flow({6, 4}, /*nu=*/0.1, /*dt=*/0.02,
                  {.boundary = {prdp::FlowBoundary::kWall, prdp::FlowBoundary::kPeriodic},
                   .wall_velocity = {{{0, prdp::FlowEnd::kHigh}, lid}}},
                  prdp::CG{200, 1e-12, prdp::Preconditioner::multigrid()});
  const auto height = (at::arange(6, at::kDouble) + 0.5) / 6.0;
  const auto u = at::stack({(0.7 * height).unsqueeze(1).expand({6, 4}), at::zeros({6, 4}, at::kDouble)}).unsqueeze(0);
  const auto next = flow(u);
  EXPECT_LT((next - u).abs().max().item<double>(), 1e-12);
  // The flow is linear in the lid: the gradient of a sum is what a lid of speed 1 drives.
  const auto gradient = torch::autograd::grad({flow(at::zeros_like(u)).sum()}, {lid})[0];
  EXPECT_NEAR(gradient[0].item<double>() * 0.7, flow(at::zeros_like(u)).sum().item<double>(), 1e-9);
}

TEST(Flow, WallVelocitiesThatDoNotFitAreNamed) {
  const auto make = [](int64_t axis, const at::Tensor& velocity) {
    prdp::Flow({6, 4}, 0.1, 0.02,
               {.boundary = {prdp::FlowBoundary::kWall, prdp::FlowBoundary::kPeriodic},
                .wall_velocity = {{{axis, prdp::FlowEnd::kLow}, velocity}}});
  };
  const auto along = at::tensor({1.0, 0.0}, at::kDouble);
  EXPECT_THROW(make(1, along), c10::ValueError);  // periodic
  EXPECT_THROW(make(2, along), c10::ValueError);
  EXPECT_THROW(make(0, along.flip(0)), c10::ValueError);  // through the wall
}

}  // namespace
