#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <numbers>

#include "prdp/grid/grid.h"
#include "prdp/scenes/data.h"
#include "prdp/scenes/loss.h"
#include "prdp/scenes/scene.h"

namespace {

std::string scene_path(const std::string& name) { return std::string(PRDP_SCENES) + "/" + name + ".toml"; }

TEST(Scene, AllScenesOfTheProjectAreRead) {
  for (const auto& entry : std::filesystem::directory_iterator(PRDP_SCENES))
    EXPECT_NO_THROW(prdp::read_scene(entry.path())) << entry.path();
}

TEST(Scene, LearningRateDecaysExponentially) {
  const auto scene = prdp::read_scene(scene_path("heat_1d"));
  EXPECT_DOUBLE_EQ(scene.learning_rate(0), 1e-3);
  EXPECT_DOUBLE_EQ(scene.learning_rate(100), 0.94e-3);
  EXPECT_NEAR(scene.learning_rate(50), 1e-3 * std::sqrt(0.94), 1e-12);
}

TEST(Data, FourierSeriesLiesInTheSpanOfItsModesWithAmplitudesInRange) {
  const prdp::Grid grid("test", {64});
  const auto u = prdp::fourier_series(grid, 20, 5, 3, at::kDouble).view({20, 64});
  std::vector<at::Tensor> modes;
  const auto x = at::arange(1, 65, at::kDouble) / 65.0;
  for (int n = 1; n <= 5; ++n) {
    modes.push_back((x * (2 * n * std::numbers::pi)).sin());
    modes.push_back((x * (2 * n * std::numbers::pi)).cos());
  }
  const auto basis = at::stack(modes, 1);
  const auto amplitudes = std::get<0>(at::linalg_lstsq(basis, u.mT()));
  EXPECT_LT((at::matmul(basis, amplitudes).mT() - u).abs().max().item<double>(), 1e-12);
  EXPECT_LE(amplitudes.abs().max().item<double>(), 1.0);
  EXPECT_GT(amplitudes.std().item<double>(), 0.4);  // U(-1, 1) has 0.577
}

TEST(Data, SameSeedSameDataOtherSeedOtherData) {
  const prdp::Grid grid("test", {6, 5});
  const auto u = prdp::fourier_series(grid, 4, 2, 0, at::kFloat);
  EXPECT_TRUE(at::equal(u, prdp::fourier_series(grid, 4, 2, 0, at::kFloat)));
  EXPECT_FALSE(at::equal(u, prdp::fourier_series(grid, 4, 2, 1, at::kFloat)));
  EXPECT_EQ(u.sizes(), (std::vector<int64_t>{4, 1, 6, 5}));
}

TEST(Data, HeatTargetsAreTwoExactSteps) {
  const auto scene = prdp::read_scene(scene_path("heat_1d"));
  const auto data = prdp::make_dataset(scene);
  EXPECT_EQ(data.train_start.sizes(), (std::vector<int64_t>{200, 1, 30}));
  EXPECT_EQ(data.valid_end.sizes(), (std::vector<int64_t>{5, 1, 30}));
  auto exact = scene.stepper(prdp::Direct{});
  EXPECT_TRUE(at::allclose(exact(exact(data.train_start)), data.train_end, 1e-5, 1e-6));
}

TEST(Loss, NormalisedErrorIsPerSample) {
  const auto reference = at::tensor({3.0, 4.0, 0.0, 1.0}).view({2, 1, 2});
  const auto u = at::tensor({3.0, 5.0, 0.0, 3.0}).view({2, 1, 2});
  EXPECT_NEAR(prdp::normalised_mse(u, reference).item<double>(), 0.5 * (1.0 / 25.0 + 4.0), 1e-6);
  EXPECT_NEAR(prdp::loss("mse", u, reference).item<double>(), 5.0 / 4.0, 1e-6);
  EXPECT_THROW(prdp::loss("l1", u, reference), c10::ValueError);
}

}  // namespace
