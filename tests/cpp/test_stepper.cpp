#include <c10/core/InferenceMode.h>
#include <gtest/gtest.h>
#include <torch/csrc/autograd/autograd.h>

#include <functional>
#include <limits>
#include <optional>

#include "helpers.h"
#include "prdp/prdp.h"

namespace {

using prdp_test::dense_laplacian;

TEST(Heat, StepEqualsDenseSolveInOneTwoAndThreeDimensions) {
  for (const auto& shape : std::vector<std::vector<int64_t>>{{30}, {17, 5}, {4, 7, 3}}) {
    auto heat = prdp::Heat(shape, /*nu=*/1e-3, /*dt=*/0.7, prdp::CG{.max_iter = 500, .rtol = 1e-13});
    const auto u = prdp_test::random_field(shape, 3);
    const auto n = u[0].numel();
    const auto a = at::eye(n, at::kDouble) - 7e-4 * dense_laplacian(shape);
    const auto expected = at::linalg_solve(a, u.view({3, n}).mT()).mT().reshape_as(u);
    EXPECT_LT((heat(u) - expected).abs().max().item<double>(), 1e-11);
    EXPECT_TRUE(heat.info()->status.eq(1).all().item<bool>());
  }
}

TEST(Heat, ImplicitGradientEqualsDenseAdjointForRhsAndViscosity) {
  const auto nu = at::scalar_tensor(2e-3, at::kDouble).requires_grad_();
  auto heat = prdp::Heat({12}, nu, 1.0, prdp::Jacobi{.max_iter = 4000, .rtol = 1e-14});
  auto u = prdp_test::random_field({12}, 2).requires_grad_();
  const auto g = prdp_test::random_field({12}, 2);
  const auto gradients = torch::autograd::grad({heat(u)}, {u, nu}, {g});

  const auto laplacian = dense_laplacian({12});
  const auto a = at::eye(12, at::kDouble) - 2e-3 * laplacian;
  const auto lambda = at::linalg_solve(a.mT(), g.view({2, 12}).mT()).mT();
  const auto next = at::linalg_solve(a, u.detach().view({2, 12}).mT()).mT();
  EXPECT_LT((gradients[0].view({2, 12}) - lambda).abs().max().item<double>(), 1e-11);
  const double expected = (lambda * at::matmul(next, laplacian.mT())).sum().item<double>();
  EXPECT_NEAR(gradients[1].item<double>(), expected, 1e-9 * std::abs(expected));
  ASSERT_TRUE(heat.adjoint_info());
  EXPECT_TRUE(heat.converged());
}

TEST(Heat, BudgetMayChangeAtAnyTime) {
  auto heat = prdp::Heat({30}, 1e-3, 1.0, prdp::Jacobi{.max_iter = 1});
  const auto u = prdp_test::random_field({30}, 2);
  for (const int64_t k : {1, 2, 7, 0}) {
    heat.set_max_iter(k);
    heat(u);
    EXPECT_TRUE(heat.info()->iterations.eq(k).all().item<bool>());
  }
  EXPECT_THROW(heat.set_max_iter(-1), c10::ValueError);
}

TEST(Heat, ABudgetKeepsThePreconditioner) {
  const auto u = prdp_test::random_field({30}, 2);
  for (const prdp::Solver& solver :
       {prdp::Solver(prdp::Multigrid{.max_iter = 1}),
        prdp::Solver(prdp::CG{.max_iter = 1, .preconditioner = prdp::Preconditioner::multigrid()})}) {
    auto heat = prdp::Heat({30}, 0.05, 1.0, solver);
    heat.set_max_iter(30);
    heat(u);
    EXPECT_TRUE(heat.converged());
    EXPECT_LT(heat.info()->iterations.max().item<int64_t>(), 15);
  }
}

TEST(Heat, ASolverThatNobodyGaveIsRefused) {
  EXPECT_THROW(prdp::Heat({30}, 0.05, 1.0, prdp::Solver{}), c10::ValueError);
  EXPECT_THROW(prdp::linear_solve(prdp::matrix(at::eye(3)), at::ones({3}), prdp::SolveOptions{}), c10::ValueError);
}

TEST(Heat, AStepThatThrowsLeavesNoReportOfAnEarlierOne) {
  auto heat = prdp::Heat({30}, 1e-3, 1.0, prdp::CG{.max_iter = 100});
  auto u = prdp_test::random_field({30}, 2);
  heat(u);
  ASSERT_TRUE(heat.info());
  u[1][0][3] = std::numeric_limits<double>::quiet_NaN();
  EXPECT_THROW(heat(u), c10::LinAlgError);
  EXPECT_FALSE(heat.info());
  EXPECT_FALSE(heat.converged());
}

TEST(Start, FromTheStateIsALinearSolveThatIsGivenTheState) {
  for (const auto backward : {prdp::Backward::kImplicit, prdp::Backward::kUnrolled}) {
    const auto nu = at::scalar_tensor(1e-2, at::kDouble).requires_grad_();
    const prdp::Solver jacobi = prdp::Jacobi{.max_iter = 3};
    auto burgers = prdp::Burgers({9}, nu, 0.1, jacobi, backward);
    auto own =
        prdp::ImplicitStep([&](const at::Tensor& u) { return prdp::OperatorSpec{"burgers", {9}, {0.1}, {u, nu}}; },
                           nullptr, jacobi, backward);
    const auto u = prdp_test::random_field({9}, 2).requires_grad_();
    const auto from_zero = burgers(u);
    burgers.options().start = own.options().start = prdp::Start::kState;
    const prdp::SolveOptions options{jacobi, backward};
    const auto first = prdp::linear_solve(burgers.operator_at(u), u, options, u).u;
    const auto second = prdp::linear_solve(burgers.operator_at(first), first, options, first).u;
    const auto expected = at::stack({u, first, second}, 1);
    EXPECT_FALSE(at::equal(first, from_zero));
    const auto truth = torch::autograd::grad({expected.square().sum()}, {u, nu});
    for (const auto& states : {burgers.rollout(u, 2), own.rollout(u, 2)}) {
      EXPECT_TRUE(at::equal(states, expected));
      const auto found = torch::autograd::grad({states.square().sum()}, {u, nu});
      EXPECT_TRUE(at::allclose(found[0], truth[0], 1e-12) && at::allclose(found[1], truth[1], 1e-12));
    }
  }
}

TEST(Start, IsNeverWorseThanZeroAndConvergesWithoutIterationsWhereItIsTheSolution) {
  auto heat = prdp::Heat({12}, 1e-3, 1.0, prdp::CG{.max_iter = 50, .rtol = 1e-9});
  const auto u = prdp_test::random_field({12}, 2), exact = heat(u);
  const prdp::SolveOptions options{prdp::CG{.max_iter = 50, .rtol = 1e-8}};
  const auto again = prdp::linear_solve(heat.operator_at(u), u, options, -3 * exact);
  EXPECT_TRUE(again.info.iterations.eq(0).all().item<bool>() && again.info.status.eq(1).all().item<bool>());
  const prdp::SolveOptions none{prdp::CG{.max_iter = 0}};
  const auto poor = prdp::linear_solve(heat.operator_at(u), u, none, prdp_test::random_field({12}, 2).flip(0));
  EXPECT_TRUE(poor.info.residual.le(1).all().item<bool>());
  EXPECT_THROW(prdp::linear_solve(heat.operator_at(u), u, none, u.narrow(2, 0, 5)), c10::ValueError);
}

TEST(Heat, CopiesReportToTheSameAdjointLog) {
  auto heat = prdp::Heat({5}, 1e-3, 1.0, prdp::Direct{});
  auto copy = heat;
  auto u = prdp_test::random_field({5}, 1).requires_grad_();
  copy(u).sum().backward();
  EXPECT_TRUE(heat.adjoint_info());
}

TEST(Heat, OneThatWasMovedFromHasNoReports) {
  auto heat = prdp::Heat({8}, 1e-3, 1.0, prdp::Jacobi{.max_iter = 2});
  auto u = at::ones({1, 1, 8}).requires_grad_();
  heat(u).sum().backward();
  const auto moved = std::move(heat);
  EXPECT_TRUE(moved.adjoint_info());
  EXPECT_FALSE(heat.adjoint_info());  // NOLINT(bugprone-use-after-move)
}

TEST(Poisson, SolvesForTheLoadWithItsSign) {
  auto poisson = prdp::Poisson({31}, prdp::Direct{});
  const auto load = prdp_test::random_field({31}, 2);
  const auto u = poisson(load).view({2, 31});
  const auto residual = at::matmul(u, dense_laplacian({31})) + load.view({2, 31});
  EXPECT_LT(residual.abs().max().item<double>(), 1e-10);
}

/// Burgers, 1D, row by row.
at::Tensor dense_burgers(const at::Tensor& winds, double nu, double dt) {
  const int64_t n = winds.numel();
  const auto w = winds.flatten();
  auto a = at::eye(n, at::kDouble);
  for (int64_t i = 0; i < n; ++i) {
    const int64_t below = (i + n - 1) % n, above = (i + 1) % n;
    const double wi = w[i].item<double>();
    const double in = n * std::max((w[below].item<double>() + wi) / 2, 0.0);
    const double out = n * std::min((wi + w[above].item<double>()) / 2, 0.0);
    const double diffusion = nu * static_cast<double>(n * n);
    a[i][i] += dt * (in - out + 2 * diffusion);
    a[i][below] -= dt * (in + diffusion);
    a[i][above] += dt * (out - diffusion);
  }
  return a;
}

TEST(Burgers, StepEqualsDenseSolveAndItsGradientADifferenceOfSteps) {
  auto burgers = prdp::Burgers({9}, 1e-2, 0.1, prdp::Direct{});
  auto u = prdp_test::random_field({9}, 2).requires_grad_();
  const auto next = burgers(u);
  for (int64_t i = 0; i < 2; ++i) {
    const auto expected = at::linalg_solve(dense_burgers(u[i].detach(), 1e-2, 0.1), u[i].flatten());
    EXPECT_LT((next[i].flatten() - expected).abs().max().item<double>(), 1e-12);
  }
  const auto g = prdp_test::random_field({9}, 2), direction = prdp_test::random_field({9}, 2);
  const auto gradient = torch::autograd::grad({next}, {u}, {g})[0];
  const at::NoGradGuard no_grad;
  const auto slope = (burgers(u + 1e-6 * direction) - burgers(u - 1e-6 * direction)) / 2e-6;
  EXPECT_NEAR((gradient * direction).sum().item<double>(), (slope * g).sum().item<double>(), 1e-6);
}

TEST(Burgers, RolloutEqualsItsStepsToTheLastBit) {
  const auto nu = at::scalar_tensor(1e-2, at::kDouble).requires_grad_();
  auto burgers = prdp::Burgers({9}, nu, 0.1, prdp::GMRES{.restart = 3, .max_iter = 2});
  auto u = prdp_test::random_field({9}, 2).requires_grad_();
  const auto g = prdp_test::random_field({9}, 2);
  auto last = u;
  for (int step = 0; step < 3; ++step) last = burgers(last);
  const auto expected = torch::autograd::grad({last}, {u, nu}, {g});
  const auto states = burgers.rollout(u, 3);
  EXPECT_TRUE(at::equal(states.select(1, 3), last));
  const auto found = torch::autograd::grad({states.select(1, 3)}, {u, nu}, {g});
  EXPECT_TRUE(at::equal(found[0], expected[0]) && at::equal(found[1], expected[1]));
  EXPECT_EQ(burgers.info()->iterations.sizes(), at::IntArrayRef({2, 3}));
  EXPECT_EQ(burgers.adjoint_info()->iterations.sizes(), at::IntArrayRef({2, 3}));
}

TEST(NavierStokes, StepIsFreeOfDivergenceAndDifferentiable) {
  auto flow = prdp::NavierStokes({6, 5}, 1e-3, 0.1, prdp::Direct{}, prdp::Backward::kImplicit, 2);
  auto u = at::cat({prdp_test::random_field({6, 5}, 2), prdp_test::random_field({6, 5}, 2),
                    prdp_test::random_field({6, 5}, 2)},
                   1)
               .requires_grad_();
  const auto next = flow(u);
  EXPECT_TRUE(flow.info()->iterations.eq(2).all().item<bool>());  // two Picard steps
  const auto b = flow.rhs(u), residual = prdp::make_operator(flow.operator_at(u))->apply(next) - b;
  EXPECT_LT(residual.select(1, 2).abs().max().item<double>(), 1e-12);
  EXPECT_LT(next.select(1, 2).mean().abs().item<double>(), 1e-13);
  (next * next).narrow(1, 0, 2).sum().backward();
  EXPECT_GT(u.grad().narrow(1, 0, 2).abs().max().item<double>(), 1e-3);
  EXPECT_EQ(u.grad().select(1, 2).abs().max().item<double>(), 0.0);
}

TEST(Flows, NormIsTheLargestAbsoluteRowSumAndNaNWhereTheWindsAre) {
  for (const int64_t batch : {1, 3}) {
    const auto nu = at::scalar_tensor(1e-2, at::kDouble);
    const auto u = prdp_test::random_field({4, 5}, batch);
    const auto winds = at::cat({u, u.flip(2)}, 1);
    for (const char* kind : {"burgers", "navier_stokes"}) {
      const auto a = prdp::make_operator({kind, {4, 5}, {0.1}, {winds, nu}});
      const auto expected = a->dense(winds.options()).abs().sum(-1).amax(-1);
      EXPECT_EQ(a->norm().sizes(), expected.sizes());
      EXPECT_TRUE(at::allclose(a->norm(), expected, 1e-12));
      auto bad = winds.clone();
      bad[batch - 1][1][2][3] = std::numeric_limits<double>::quiet_NaN();
      const auto norm = prdp::make_operator({kind, {4, 5}, {0.1}, {bad, nu}})->norm().reshape(-1);
      for (int64_t i = 0; i < batch; ++i) EXPECT_EQ(std::isnan(norm[i].item<double>()), i == batch - 1);
    }
  }
}

TEST(Flows, ProjectionTakesOffTheMeanPressureAlone) {
  const auto nu = at::scalar_tensor(1e-2, at::kDouble);
  const auto u = prdp_test::random_field({4, 5}, 2);
  const auto v = at::cat({u, u.flip(2), u + 3.0}, 1);
  for (const bool transposed : {false, true}) {
    const auto a = prdp::make_operator({"navier_stokes", {4, 5}, {0.1}, {v, nu}, transposed});
    const auto projected = a->project(v);
    EXPECT_TRUE(at::equal(projected.narrow(1, 0, 2), v.narrow(1, 0, 2)));
    EXPECT_TRUE(
        at::allclose(v.select(1, 2) - projected.select(1, 2), v.select(1, 2).mean({1, 2}, true).expand({2, 4, 5})));
    EXPECT_TRUE(at::equal(prdp::make_operator({"burgers", {4, 5}, {0.1}, {v.narrow(1, 0, 2), nu}})->project(v), v));
  }
}

TEST(Stepper, RefusesBadArgumentsBeforeAnyWork) {
  EXPECT_THROW(prdp::Heat({30}, -1e-3, 1.0, prdp::Jacobi{.max_iter = 1}), c10::ValueError);
  EXPECT_THROW(prdp::Heat({30}, 1e-3, 0.0, prdp::Jacobi{.max_iter = 1}), c10::ValueError);
  EXPECT_THROW(prdp::Heat({}, 1e-3, 1.0, prdp::Jacobi{.max_iter = 1}), c10::ValueError);
  EXPECT_THROW(prdp::Heat({30}, 1e-3, 1.0, prdp::Jacobi{.max_iter = -1}), c10::ValueError);
  EXPECT_THROW(prdp::Heat({30}, 1e-3, 1.0, prdp::Jacobi{.max_iter = 1, .rtol = -1.0}), c10::ValueError);
  EXPECT_THROW(prdp::Heat({30}, 1e-3, 1.0, prdp::CG{.rtol = 1e-5}), c10::ValueError);  // without a max_iter
  auto heat = prdp::Heat({30}, 1e-3, 1.0, prdp::Jacobi{.max_iter = 1});
  EXPECT_THROW(heat(at::zeros({25, 30})), c10::ValueError);
  EXPECT_THROW(heat(at::zeros({25, 1, 30}, at::kLong)), c10::TypeError);
  EXPECT_THROW(prdp::Burgers({8}, 1e-3, 0.0, prdp::Direct{}), c10::ValueError);
  EXPECT_THROW(prdp::Burgers({8, 8, 8}, 1e-3, 0.1, prdp::Direct{}), c10::ValueError);
  EXPECT_THROW(prdp::NavierStokes({8}, 1e-3, 0.1, prdp::Direct{}), c10::ValueError);
  auto flow = prdp::NavierStokes({4, 5}, 1e-3, 0.1, prdp::Direct{});
  EXPECT_THROW(flow(at::zeros({2, 2, 4, 5})), c10::ValueError);
}

/// The words of what f() raises.
template <class F>
std::string said(const F& f) {
  try {
    f();
  } catch (const c10::ValueError& error) {
    return error.what_without_backtrace();
  }
  return "nothing";
}

TEST(Stepper, OneMadeInInferenceModeHasGradientsLater) {
  std::optional<prdp::Heat> heat;
  std::optional<prdp::Flow> flow;
  {
    const c10::InferenceMode inference;
    heat.emplace(std::vector<int64_t>{8}, 1e-2, 1.0, prdp::CG{.max_iter = 60, .rtol = 1e-12});
    flow.emplace(std::vector<int64_t>{8, 8}, 1e-2, 1e-3);
  }
  const auto u = prdp_test::random_field({8}, 2).requires_grad_();
  (*heat)(u).sum().backward();
  const auto a = at::eye(8, at::kDouble) - 1e-2 * dense_laplacian({8});
  EXPECT_TRUE(at::allclose(u.grad()[1][0], at::linalg_solve(a, at::ones({8}, at::kDouble)), 1e-9, 1e-12));
  const auto velocity = at::zeros({1, 2, 8, 8}, at::kDouble).requires_grad_();
  (*flow)(velocity).sum().backward();
  EXPECT_TRUE(velocity.grad().defined());
}

TEST(Stepper, WhatMakesNoStepSaysWhy) {
  const auto u = at::ones({1, 1, 8}, at::kDouble);
  const prdp::Solver cg = prdp::CG{.max_iter = 20};
  auto heat = prdp::Heat({8}, 1e-2, 1.0, cg);
  EXPECT_EQ(said([&] { heat(at::Tensor()); }), "Heat: u is an undefined tensor");
  EXPECT_EQ(said([&] { heat.rollout(u.to_sparse(), 2); }), "Heat: u must be a dense tensor, got the layout Sparse");
  EXPECT_EQ(said([&] { prdp::Heat({8}, 1e-2, 1.0, prdp::CG{}); }),
            "Heat: max_iter must be >= 0, got -1 (which it is where none is given)");

  auto step = prdp::ImplicitStep(prdp::diffusion(at::ones({1, 8}, at::kDouble)), nullptr, cg);
  auto flow = prdp::Flow({8, 8}, 1e-2, 1e-3);
  const auto moved_step = std::move(step);
  auto moved_flow = std::move(flow);
  const std::string moved = "a stepper that was moved from makes no steps";
  EXPECT_EQ(said([&] { step(u); }), moved);
  EXPECT_EQ(said([&] { step.rollout(u, 2); }), moved);
  EXPECT_EQ(said([&] { flow(u); }), moved);
  EXPECT_NE(said([&] { flow.project(u); }).find("one that was moved from has none"), std::string::npos);

  moved_flow.options().start = prdp::Start::kState;
  const auto velocity = at::zeros({1, 2, 8, 8}, at::kDouble);
  for (const auto& call :
       std::vector<std::function<void()>>{[&] { moved_flow(velocity); }, [&] { moved_flow.rollout(velocity, 2); },
                                          [&] { moved_flow.step_and_pressure(velocity); }})
    EXPECT_EQ(said(call), "Flow: start must be Start::kZero: its solves are for changes");
}

}  // namespace
