#include <c10/util/Exception.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <type_traits>

#include "prdp/controller/attach.h"
#include "prdp/controller/linear_schedule.h"
#include "prdp/controller/prdp_controller.h"
#include "prdp/controller/tolerance_controller.h"
#include "prdp/steppers/implicit_step.h"
#include "prdp/steppers/steppers.h"

namespace {

using prdp::PRDPController;
using prdp::PRDPSettings;

/// A controller that smooths nothing and looks two values back.
PRDPController plain(PRDPSettings settings = {}) {
  settings.window = 1;
  settings.delta = 2;
  return PRDPController(settings);
}

TEST(PRDPController, WaitsUntilThereAreDeltaPlusOneValues) {
  auto controller = plain();
  EXPECT_FALSE(controller.step(1.0));
  EXPECT_FALSE(controller.step(1.0));
  EXPECT_TRUE(controller.step(1.0));
}

TEST(PRDPController, KeepsKWhileTheMetricFalls) {
  auto controller = plain();
  double metric = 1.0;
  for (int i = 0; i < 50; ++i) EXPECT_FALSE(controller.step(metric *= 0.9));
  EXPECT_EQ(controller.max_iter(), 1);
}

TEST(PRDPController, RefinesAConstantMetricOnceOnly) {
  PRDPController controller;
  int refinements = 0;
  for (int i = 0; i < 200; ++i) refinements += controller.step(0.37);
  EXPECT_EQ(refinements, 1);
}

TEST(PRDPController, RefinesAgainOnlyWhereTheLastRefinementPaidOrTheMetricGrew) {
  auto controller = plain();
  for (const double metric : {1.0, 1.0, 1.0}) controller.step(metric);
  EXPECT_EQ(controller.max_iter(), 2);
  for (const double metric : {0.95, 0.95, 0.95}) controller.step(metric);  // above τ_stop · 1.0
  EXPECT_EQ(controller.max_iter(), 2);
  for (const double metric : {0.8, 0.8}) controller.step(metric);  // below it
  EXPECT_EQ(controller.max_iter(), 3);
  EXPECT_TRUE(controller.step(0.9));  // worse than at the last refinement
}

TEST(PRDPController, GrowsByAFactorButAtLeastByTheIncrement) {
  PRDPSettings settings;
  settings.growth = 1.5;
  settings.maximum = 40;
  auto controller = plain(settings);
  std::vector<int64_t> seen;
  double metric = 1.0;
  for (int i = 0; i < 60; ++i) {
    if (i % 3 == 0) metric *= 0.5;
    if (controller.step(metric)) seen.push_back(controller.max_iter());
  }
  EXPECT_EQ(seen, (std::vector<int64_t>{2, 3, 5, 8, 12, 18, 27, 40}));
}

TEST(PRDPController, KeepsKWhereSolvesAlreadyMeetTheirTolerance) {
  auto controller = plain();
  for (int i = 0; i < 20; ++i) EXPECT_FALSE(controller.step(1.0, /*converged=*/true));
  EXPECT_EQ(controller.state().checkpoint, std::numeric_limits<double>::infinity());
  EXPECT_TRUE(controller.step(1.0, /*converged=*/false));
}

// An error in the place of Solves would pass for "converged".
static_assert(std::is_convertible_v<bool, prdp::Solves> && !std::is_convertible_v<double, prdp::Solves>);

TEST(PRDPController, ABadMetricRaisesAndChangesNothing) {
  PRDPController controller;
  controller.step(1.0);
  for (const double bad : {-1.0, std::nan(""), std::numeric_limits<double>::infinity()}) {
    EXPECT_THROW(controller.step(bad), c10::ValueError);
    EXPECT_EQ(controller.state().history.size(), 1u);
  }
}

TEST(PRDPController, StaysFiniteOverLongHistories) {
  PRDPController controller;
  for (int i = 0; i < 20000; ++i) controller.step(1.0 + 0.5 * std::sin(i));
  EXPECT_TRUE(std::isfinite(controller.state().history.back().smoothed));
}

TEST(PRDPController, AMetricOfZeroIsNoTrouble) {
  PRDPController controller;
  for (int i = 0; i < 10; ++i) EXPECT_FALSE(controller.step(0.0));
}

TEST(LinearSchedule, GrowsByItsStepUpToTheMaximum) {
  prdp::LinearSchedule schedule(25, 6, 40);
  std::vector<int64_t> seen{schedule.max_iter()};
  for (int i = 0; i < 4; ++i) {
    schedule.step();
    seen.push_back(schedule.max_iter());
  }
  EXPECT_EQ(seen, (std::vector<int64_t>{25, 31, 37, 40, 40}));
  EXPECT_THROW(prdp::LinearSchedule(25, 6, 24), c10::ValueError);
}

TEST(ToleranceController, TiesTheToleranceToTheSmallestErrorSoFar) {
  prdp::ToleranceController controller({.ratio = 0.1, .adjoint_ratio = 0.2, .floor = 1e-3});
  EXPECT_DOUBLE_EQ(controller.rtol(), 1e-3);  // nothing is known
  EXPECT_FALSE(controller.step(7.0));  // an error above 1 is worse than no answer, and asks for no more
  EXPECT_DOUBLE_EQ(controller.rtol(), 0.1);
  EXPECT_TRUE(controller.step(0.4));
  EXPECT_DOUBLE_EQ(controller.rtol(), 0.04);
  EXPECT_DOUBLE_EQ(controller.adjoint_rtol(), 0.1);  // its bound
  EXPECT_TRUE(controller.step(0.1));
  EXPECT_DOUBLE_EQ(controller.adjoint_rtol(), 0.05);
  EXPECT_FALSE(controller.step(0.9));
  EXPECT_DOUBLE_EQ(controller.rtol(), 0.01);
  EXPECT_TRUE(controller.step(0.0));
  EXPECT_DOUBLE_EQ(controller.rtol(), 1e-3);
  EXPECT_DOUBLE_EQ(controller.adjoint_rtol(), 1e-2);  // its floor
  EXPECT_EQ(controller.max_iter(), 10000);
  EXPECT_EQ(controller.budget().adjoint_max_iter, 2000);
}

TEST(ToleranceController, LetsAnAdjointSolveBeLooserThanATenthOnlyWhereItIsTold) {
  const auto after_no_success = [](prdp::ToleranceSettings settings) {
    prdp::ToleranceController controller(settings);
    controller.step(1.0);
    return controller.adjoint_rtol();
  };
  EXPECT_DOUBLE_EQ(after_no_success({}), 0.1);
  EXPECT_DOUBLE_EQ(after_no_success({.ratio = 0.8}), 0.8);
  EXPECT_DOUBLE_EQ(after_no_success({.adjoint_floor = 0.5}), 0.5);
}

TEST(ToleranceController, ABadErrorRaisesAndChangesNothing) {
  prdp::ToleranceController controller;
  controller.step(0.3);
  for (const double bad : {-1.0, std::nan(""), std::numeric_limits<double>::infinity()}) {
    EXPECT_THROW(controller.step(bad), c10::ValueError);
    EXPECT_EQ(controller.state().history.size(), 1u);
  }
  EXPECT_THROW(prdp::ToleranceController({.ratio = 1.0}), c10::ValueError);
  EXPECT_THROW(prdp::ToleranceController({.adjoint_ratio = 0.0}), c10::ValueError);
  EXPECT_THROW(prdp::ToleranceController({.floor = 0.0}), c10::ValueError);
  EXPECT_THROW(prdp::ToleranceController({.adjoint_floor = 0.0}), c10::ValueError);
  EXPECT_THROW(prdp::ToleranceController({.maximum = 0}), c10::ValueError);
}

TEST(Controller, GivesTheAdjointItsShareOfK) {
  const PRDPController controller({.initial = 7, .adjoint_ratio = 0.3});
  EXPECT_EQ(controller.budget().adjoint_max_iter, 3);
  EXPECT_EQ(prdp::LinearSchedule(5, 0, 5, 0.2).budget().adjoint_max_iter, 1);
  EXPECT_FALSE(PRDPController().budget().adjoint_max_iter.has_value());
  EXPECT_THROW(PRDPController({.adjoint_ratio = 1.5}), c10::ValueError);
  EXPECT_THROW(prdp::LinearSchedule(5, 0, 5, 0.0), c10::ValueError);
}

TEST(Controller, SetsTheBudgetOfASolveAndReadsHowItWent) {
  std::vector<prdp::Stepper> steppers{prdp::Heat({30}, 1e-3, 1.0, prdp::Jacobi{.max_iter = 1})};
  EXPECT_FALSE(prdp::last_solves(steppers).residual.has_value());
  prdp::ToleranceController controller;
  controller.step(0.2);
  prdp::set_budget(steppers[0], controller.budget());
  auto u = at::randn({3, 1, 30}, at::kDouble).requires_grad_();
  steppers[0](u).sum().backward();
  const auto solves = prdp::last_solves(steppers);
  EXPECT_TRUE(solves.converged);
  EXPECT_LE(*solves.residual, 0.02);
  EXPECT_GT(*solves.residual, 0.001);  // no more than it was asked for
  EXPECT_GT(steppers[0].adjoint_info()->residual.max().item<double>(), 0.02);
  EXPECT_LE(steppers[0].adjoint_info()->residual.max().item<double>(), 0.2);
}

TEST(Controller, CountsTheResidualOfSamplesThatDidNotFail) {
  std::vector<prdp::Stepper> steppers{prdp::Heat({30}, 1e-1, 1.0, prdp::Jacobi{.max_iter = 2})};
  steppers[0].options().on_failure = prdp::OnFailure::kReturn;
  auto u = at::randn({3, 1, 30}, at::kDouble);
  u[1].fill_(NAN);
  steppers[0](u);
  const auto residual = steppers[0].info()->residual;
  EXPECT_DOUBLE_EQ(*prdp::last_solves(steppers).residual, (residual[0] + residual[2]).item<double>() / 2);
}

TEST(Controller, WarnsWhereTheSolversErrorMakesUpWhatIsTrained) {
  PRDPController controller;
  EXPECT_FALSE(controller.warning().has_value());
  controller.step(0.04, {false, 0.01, 0.2});
  EXPECT_FALSE(controller.warning().has_value());
  controller.step(0.04, {false, 0.1, 0.2});
  EXPECT_NE(controller.warning()->find("PRDPController: the solves stop at a residual of 1.0e-01 (K = 1)"),
            std::string::npos);
  controller.step(1e-12, {false, 9e-5, 1e-6});  // as good as converged
  EXPECT_FALSE(controller.warning().has_value());
}

TEST(Controller, WarnsOfAStalledMetricWhereNoErrorIsKnown) {
  auto controller = plain();
  for (const double metric : {5.0, 4.0, 3.0}) controller.step(metric, {false, 0.3});
  EXPECT_FALSE(controller.warning().has_value());  // it still falls
  controller.step(3.0, {false, 0.3});
  EXPECT_NE(controller.warning()->find("no longer falls"), std::string::npos);
  controller.step(1.0, {false, 0.3});
  EXPECT_FALSE(controller.warning().has_value());
}

TEST(Controller, SaysThatAMetricIsNoNumberOrGrows) {
  PRDPController controller;
  for (const double metric : {1.0, 0.1, 0.5, 0.6}) controller.step(metric);
  EXPECT_FALSE(controller.warning().has_value());
  controller.step(0.7);
  EXPECT_NE(controller.warning()->find("PRDPController: the metric grows: 7.0e-01 after 1.0e-01 in interval 1"),
            std::string::npos);
  controller.step(0.1);
  EXPECT_FALSE(controller.warning().has_value());
  EXPECT_THROW(controller.step(std::nan("")), c10::ValueError);
  EXPECT_NE(controller.warning()->find("the last metric was nan, and nothing was changed. Go back"), std::string::npos);
}

TEST(Controller, GoesOnFromAStateAsIfItHadNotStopped) {
  const auto goes_on = [](prdp::Controller& whole, prdp::Controller& rest) {
    for (int i = 0; i < 40; ++i) {
      const double metric = 1.0 / (1 + i / 4);
      const bool raised = whole.step(metric);
      if (i < 16) continue;
      if (i == 16) {
        rest.load_state(whole.state());
      } else {
        EXPECT_EQ(rest.step(metric), raised);
      }
      EXPECT_EQ(rest.max_iter(), whole.max_iter());
    }
  };
  PRDPController a, b;
  goes_on(a, b);
  EXPECT_GT(a.max_iter(), 2);
  prdp::ToleranceController e, f;
  goes_on(e, f);
  EXPECT_LT(e.rtol(), 0.02);
  EXPECT_EQ(e.rtol(), f.rtol());
  prdp::LinearSchedule c(1, 2, 60), d(1, 2, 60);
  goes_on(c, d);
  EXPECT_EQ(c.max_iter(), 60);
  EXPECT_THROW(c.load_state({0}), c10::ValueError);
  EXPECT_THROW(c.load_state({61}), c10::ValueError);
}

TEST(Controllers, KStopsAtTheLargestNumber) {
  constexpr int64_t kMost = std::numeric_limits<int64_t>::max();
  const auto last = [](auto controller) {
    for (int i = 0; i < 20; ++i) {
      const int64_t before = controller.max_iter();
      const bool raised = controller.step(1.0 + i);
      EXPECT_EQ(raised, controller.max_iter() > before);
    }
    return controller.max_iter();
  };
  EXPECT_EQ(last(PRDPController({.delta = 2, .window = 1, .increment = kMost})), kMost);
  EXPECT_EQ(last(PRDPController({.delta = 2, .window = 1, .initial = kMost - 1})), kMost);
  EXPECT_EQ(last(PRDPController({.delta = 2, .window = 1, .increment = kMost, .maximum = 7})), 7);
  EXPECT_EQ(last(PRDPController({.delta = 2, .window = 1, .growth = 1e18})), kMost);
  EXPECT_EQ(last(PRDPController({.window = kMost})), 2);
  EXPECT_EQ(last(PRDPController({.delta = kMost})), 1);
  EXPECT_EQ(last(prdp::LinearSchedule(1, kMost, kMost)), kMost);
  EXPECT_EQ(last(prdp::LinearSchedule(5, kMost, 9)), 9);
}

TEST(Controller, TakesStepsOfOnesOwnEquation) {
  prdp::ImplicitStep own(prdp::OperatorSpec{"heat", {30}, {1.0}, {at::scalar_tensor(1e-3, at::kDouble)}}, nullptr,
                         prdp::CG{.max_iter = 100});
  prdp::ToleranceController controller;
  controller.step(0.2);
  prdp::set_budget(own, controller.budget());
  own.rollout(at::randn({3, 1, 30}, at::kDouble), 4);
  const auto solves = prdp::last_solves({&own});
  EXPECT_TRUE(solves.converged);
  EXPECT_LE(*solves.residual, 0.02);
  EXPECT_GT(*solves.residual, 0.0001);
}

}  // namespace
