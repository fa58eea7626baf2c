#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "helpers.h"
#include "prdp/prdp.h"
#include "prdp_experiments/training/failures.h"

/// What failed samples say, and the gradient that they do not get.
namespace {

using prdp::linear_solve;
using prdp::OnFailure;

at::Tensor matrix(std::vector<double> values) {
  const auto n = static_cast<int64_t>(std::lround(std::sqrt(values.size())));
  return at::tensor(values, at::kDouble).view({n, n});
}

std::string said_of(const prdp::OperatorSpec& a, const at::Tensor& b, prdp::Solver solver) {
  try {
    linear_solve(a, b, {std::move(solver)});
  } catch (const c10::LinAlgError& error) {
    return error.what_without_backtrace();
  }
  return "no failure";
}

void expect_said(const prdp::OperatorSpec& a, const at::Tensor& b, prdp::Solver solver,
                 const std::vector<std::string>& parts) {
  const auto said = said_of(a, b, std::move(solver));
  for (const auto& part : parts) EXPECT_NE(said.find(part), std::string::npos) << part << " is not in: " << said;
}

TEST(Failures, NameOperatorSampleAndRemedy) {
  const auto strong = 0.1 * at::eye(3, at::kDouble) + 0.9;  // Jacobi's rho is 1.8
  const auto swap = matrix({0, 1, 1, 0}), turn = matrix({0, 1, -1, 0}), ones = matrix({1, 1, 1, 1});
  const auto e1 = at::tensor({1.0, 0.0}, at::kDouble), b3 = at::tensor({1.0, 2.0, 3.0}, at::kDouble);
  const double infinity = std::numeric_limits<double>::infinity();
  expect_said(prdp::matrix(strong), b3, prdp::Jacobi{500},
              {"1 of 1 samples failed: sample 0 DIVERGED", "Jacobi on Matrix:", "larger than 1",
               "take CG if A is positive definite, else MINRES"});
  expect_said(prdp::matrix(swap), e1, prdp::Jacobi{5}, {"ZERO_DIAGONAL in row (0,)", "take MINRES"});
  expect_said(prdp::matrix(swap), e1, prdp::CG{.max_iter = 5},
              {"BREAKDOWN", "CG on Matrix:", "A is symmetric but not definite to float64: take MINRES"});
  expect_said(prdp::matrix(turn), e1, prdp::SteepestDescent{5},
              {"BREAKDOWN", "A is not symmetric", "With OnFailure::kReturn, what there is"});  // in C++'s words
  expect_said(prdp::matrix(ones), e1, prdp::GMRES{.restart = 2, .max_iter = 9},
              {"BREAKDOWN", "GMRES(2) on Matrix:", "b lies outside its range"});
  expect_said(prdp::matrix(ones), e1, prdp::Direct{}, {"BREAKDOWN", "Direct on Matrix: A is singular"});
  expect_said(prdp::matrix(0.1 * at::eye(2)), at::full({2}, 3e38, at::kFloat), prdp::CG{.max_iter = 5},
              {"OVERFLOW", "the range of float32", "take float64"});
  const auto flow = at::zeros({1, 3, 4, 4}, at::kDouble);
  const prdp::OperatorSpec a{"navier_stokes", {4, 4}, {0.1}, {flow, at::scalar_tensor(1e-3, at::kDouble)}};
  expect_said(a, at::ones_like(flow), prdp::Jacobi{5},
              {"ZERO_DIAGONAL in row (2, 0, 0)", "Jacobi on NavierStokes: the pressure rows have a zero diagonal"});
  expect_said(a, at::ones_like(flow), prdp::GMRES{.max_iter = 5},
              {"INCONSISTENT", "57.7 % of b is the mean of its pressure channel"});
  const prdp::OperatorSpec heat{"heat", {4}, {1.0}, {at::scalar_tensor(1e-3, at::kDouble)}};
  expect_said(heat, at::full({1, 1, 4}, infinity, at::kDouble), prdp::Jacobi{5},
              {"NONFINITE_INPUT at index (0, 0)", "Jacobi on Heat: the right-hand side is NaN or Inf there"});
}

TEST(Failures, AnUndefinedTensorIsAnErrorInWords) {
  const prdp::OperatorSpec heat{"heat", {4}, {1.0}, {at::Tensor()}};
  EXPECT_THROW(linear_solve(heat, at::ones({1, 1, 4}), {prdp::Jacobi{5}}), c10::ValueError);
  EXPECT_THROW(prdp::last_solves({nullptr}), c10::ValueError);
}

TEST(Failures, HandOutNoGradientWithZeroGrad) {
  for (const auto backward : {prdp::Backward::kImplicit, prdp::Backward::kUnrolled}) {
    const auto fine = matrix({3, 1, 0, 1, 4, -1, .5, 0, 2}), strong = 0.1 * at::eye(3, at::kDouble) + 0.9;
    const auto gradients = [&](const std::vector<at::Tensor>& matrices, const at::Tensor& rhs) {
      const auto a = at::stack(matrices).requires_grad_(), b = rhs.clone().requires_grad_();
      prdp::SolveOptions options{prdp::Jacobi{500}, backward};
      options.on_failure = OnFailure::kZeroGrad;
      linear_solve(prdp::matrix(a), b, options).u.sin().sum().backward();
      return std::pair(a.grad(), b.grad());
    };
    const auto b = at::tensor({1.0, 2.0, 3.0, 1.0, 0.0, 0.0}, at::kDouble).view({2, 3});
    const auto [of_a, of_b] = gradients({fine, strong}, b);
    const auto [alone_a, alone_b] = gradients({fine}, b.slice(0, 0, 1));
    EXPECT_TRUE(at::equal(of_a[0], alone_a[0]));
    EXPECT_TRUE(at::equal(of_b[0], alone_b[0]));
    EXPECT_FALSE(of_a[1].any().item<bool>());
    EXPECT_FALSE(of_b[1].any().item<bool>());
    EXPECT_TRUE(of_b[0].any().item<bool>());
  }
}

TEST(Failures, StayOutOfALossThatIsMadeOfThem) {
  const auto u = at::ones({2, 3}).requires_grad_();
  const auto status = at::tensor({int64_t{-1}, int64_t{-3}});
  const auto held = prdp::detach_failed(u, status);
  EXPECT_TRUE(at::equal(held, u));
  held.sum().backward();
  EXPECT_TRUE(at::equal(u.grad(), at::tensor({1.0f, 1.0f, 1.0f, 0.0f, 0.0f, 0.0f}).view({2, 3})));
  EXPECT_THROW(prdp::detach_failed(at::ones({3, 3}), status), c10::ValueError);
}

TEST(Failures, AreCountedAndNamed) {
  prdp::Failures failures;
  failures.take({at::tensor({int64_t{1}, int64_t{-3}})}, {at::tensor({int64_t{-5}, int64_t{1}})},
                at::tensor({int64_t{8}, int64_t{5}}));
  EXPECT_EQ(failures.line(3),
            "interval 3: 2 failed samples: sample 8 BREAKDOWN in the adjoint solve, sample 5 DIVERGED in the forward "
            "solve");
}

TEST(Warnings, GoToASinkAndBack) {
  static int taken;
  taken = 0;
  auto heat = prdp::Heat({9}, 0.1, 1.0, prdp::CG{.max_iter = 9});
  heat.options().on_failure = prdp::OnFailure::kWarn;
  const auto bad = at::full({1, 1, 9}, NAN);
  prdp::set_warning_sink([](const std::string&) { ++taken; });
  heat(bad);
  prdp::set_warning_sink(nullptr);
  testing::internal::CaptureStderr();
  heat(bad);
  EXPECT_NE(testing::internal::GetCapturedStderr().find("NONFINITE_INPUT"), std::string::npos);
  EXPECT_EQ(taken, 1);
}

}  // namespace
