#include <gtest/gtest.h>
#include <torch/csrc/autograd/autograd.h>

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

TEST(Heat, CopiesReportToTheSameAdjointLog) {
  auto heat = prdp::Heat({5}, 1e-3, 1.0, prdp::Direct{});
  auto copy = heat;
  auto u = prdp_test::random_field({5}, 1).requires_grad_();
  copy(u).sum().backward();
  EXPECT_TRUE(heat.adjoint_info());
}

TEST(Poisson, SolvesForTheLoadWithItsSign) {
  auto poisson = prdp::Poisson({31}, prdp::Direct{});
  const auto load = prdp_test::random_field({31}, 2);
  const auto u = poisson(load).view({2, 31});
  const auto residual = at::matmul(u, dense_laplacian({31})) + load.view({2, 31});
  EXPECT_LT(residual.abs().max().item<double>(), 1e-10);
}

TEST(Stepper, RefusesBadArgumentsBeforeAnyWork) {
  EXPECT_THROW(prdp::Heat({30}, -1e-3, 1.0, prdp::Jacobi{.max_iter = 1}), c10::ValueError);
  EXPECT_THROW(prdp::Heat({30}, 1e-3, 0.0, prdp::Jacobi{.max_iter = 1}), c10::ValueError);
  EXPECT_THROW(prdp::Heat({}, 1e-3, 1.0, prdp::Jacobi{.max_iter = 1}), c10::ValueError);
  EXPECT_THROW(prdp::Heat({30}, 1e-3, 1.0, prdp::Jacobi{.max_iter = -1}), c10::ValueError);
  EXPECT_THROW(prdp::Heat({30}, 1e-3, 1.0, prdp::Jacobi{.max_iter = 1, .rtol = -1.0}), c10::ValueError);
  auto heat = prdp::Heat({30}, 1e-3, 1.0, prdp::Jacobi{.max_iter = 1});
  EXPECT_THROW(heat(at::zeros({25, 30})), c10::ValueError);
  EXPECT_THROW(heat(at::zeros({25, 1, 30}, at::kLong)), c10::TypeError);
}

}  // namespace
