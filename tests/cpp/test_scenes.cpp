#include <gtest/gtest.h>
#include <torch/utils.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <numbers>

#include "prdp/networks/resnet.h"
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
  const auto u = prdp::fourier_series({"heat", {64}}, 20, 5, 3, at::kDouble).view({20, 64});
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

TEST(Data, PeriodicSeriesHoldsItsModesAloneWithTheAmplitudesThatWereDrawn) {
  constexpr int64_t kSamples = 7, kModes = 20, kN = 256;
  const prdp::Scene::Physics burgers{"burgers", {kN}};
  const auto u = prdp::fourier_series(burgers, kSamples, kModes, 3, at::kDouble);
  ASSERT_EQ(u.sizes(), (std::vector<int64_t>{kSamples, 1, kN}));
  // With x_i = i/N the transform has (cosine - i sine) N/2 at n = 1 … modes and nothing elsewhere.
  const auto spectrum = at::view_as_real(at::fft_rfft(u.squeeze(1))) * (2.0 / kN);
  auto generator = prdp::make_generator(3);
  const auto drawn = at::rand({kSamples, kModes, 2}, generator, at::TensorOptions(at::kDouble)) * 2.0 - 1.0;
  const auto held = spectrum.narrow(1, 1, kModes);
  EXPECT_TRUE(at::allclose(held.select(2, 0), drawn.select(2, 1), 0.0, 1e-13));
  EXPECT_TRUE(at::allclose(held.select(2, 1), -drawn.select(2, 0), 0.0, 1e-13));
  EXPECT_LT(spectrum.select(1, 0).abs().max().item<double>(), 1e-13);
  EXPECT_LT(spectrum.narrow(1, kModes + 1, kN / 2 - kModes).abs().max().item<double>(), 1e-13);
}

TEST(Data, AVelocityHasAComponentOfItsOwnForEachAxis) {
  const auto u = prdp::fourier_series({"burgers", {8, 10}}, 3, 2, 0, at::kDouble);
  EXPECT_EQ(u.sizes(), (std::vector<int64_t>{3, 2, 8, 10}));
  EXPECT_FALSE(at::allclose(u.select(1, 0), u.select(1, 1)));
}

TEST(Data, SameSeedSameDataOtherSeedOtherData) {
  const prdp::Scene::Physics heat{"heat", {6, 5}};
  const auto u = prdp::fourier_series(heat, 4, 2, 0, at::kFloat);
  EXPECT_TRUE(at::equal(u, prdp::fourier_series(heat, 4, 2, 0, at::kFloat)));
  EXPECT_FALSE(at::equal(u, prdp::fourier_series(heat, 4, 2, 1, at::kFloat)));
  EXPECT_EQ(u.sizes(), (std::vector<int64_t>{4, 1, 6, 5}));
}

TEST(Data, HeatTargetsAreExactStepsAsManyAsTheSceneSays) {
  auto scene = prdp::read_scene(scene_path("heat_1d"));
  scene.data.valid_steps = 3;
  const auto data = prdp::make_dataset(scene);
  EXPECT_EQ(data.train_start.sizes(), (std::vector<int64_t>{200, 1, 30}));
  EXPECT_EQ(data.valid_end.sizes(), (std::vector<int64_t>{5, 1, 30}));
  auto exact = scene.stepper(prdp::Direct{});
  EXPECT_TRUE(at::allclose(exact(exact(data.train_start)), data.train_end, 1e-5, 1e-6));
  EXPECT_TRUE(at::allclose(exact(exact(exact(data.valid_start))), data.valid_end, 1e-5, 1e-6));
}

/// Whether moving the input by `by` points along `axis` moves the output alike.
bool commutes_with_shift(prdp::ResNet& network, const at::Tensor& u, int64_t by, int64_t axis) {
  return at::allclose(network(u.roll(by, axis)), network(u).roll(by, axis), 1e-9, 1e-12);
}

TEST(ResNet, KeepsTheShapeAndWrapsOnlyWhereItIsPeriodic) {
  torch::manual_seed(0);
  const std::vector<std::vector<int64_t>> shapes{{13}, {7, 9}, {5, 6, 7}};
  for (const auto& shape : shapes) {
    const auto dim = static_cast<int64_t>(shape.size()), channels = dim;
    std::vector<int64_t> sizes{3, channels};
    sizes.insert(sizes.end(), shape.begin(), shape.end());
    const auto u = at::randn(sizes, at::kDouble);
    prdp::ResNet periodic(dim, channels, 2, 4, true), zeros(dim, channels, 2, 4, false);
    periodic->to(at::kDouble);
    zeros->to(at::kDouble);
    EXPECT_EQ(periodic(u).sizes(), u.sizes());
    EXPECT_EQ(zeros(u).sizes(), u.sizes());
    for (int64_t axis = 2; axis < dim + 2; ++axis) {
      EXPECT_TRUE(commutes_with_shift(periodic, u, 2, axis)) << "dim " << dim << " axis " << axis;
      EXPECT_FALSE(commutes_with_shift(zeros, u, 2, axis)) << "dim " << dim << " axis " << axis;
    }
  }
}

TEST(ResNet, HasTheParametersOfItsPythonTwin) {
  prdp::ResNet network(1, 1, 6, 32, true);
  const auto parameters = network->named_parameters();
  EXPECT_EQ(parameters.size(), 2u + 6u * 4u + 2u);
  EXPECT_EQ(parameters[0].key(), "lift.weight");
  EXPECT_EQ(parameters[4].key(), "blocks.0.2.weight");
  EXPECT_EQ(parameters[27].key(), "project.bias");
  EXPECT_EQ(parameters["blocks.5.0.weight"].sizes(), (std::vector<int64_t>{32, 32, 3}));
  EXPECT_THROW(prdp::ResNet(4, 1, 1, 1, true), c10::ValueError);
}

TEST(Loss, NormalisedErrorIsPerSample) {
  const auto reference = at::tensor({3.0, 4.0, 0.0, 1.0}).view({2, 1, 2});
  const auto u = at::tensor({3.0, 5.0, 0.0, 3.0}).view({2, 1, 2});
  EXPECT_NEAR(prdp::normalised_mse(u, reference).item<double>(), 0.5 * (1.0 / 25.0 + 4.0), 1e-6);
  EXPECT_NEAR(prdp::loss("mse", u, reference).item<double>(), 5.0 / 4.0, 1e-6);
  EXPECT_THROW(prdp::loss("l1", u, reference), c10::ValueError);
}

}  // namespace
