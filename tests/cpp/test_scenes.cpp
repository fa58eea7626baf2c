#include <gtest/gtest.h>
#include <torch/utils.h>

#include <cmath>
#include <filesystem>
#include <fstream>
#include <numbers>

#include "prdp/grid/grid.h"
#include "prdp/operators/navier_stokes_operator.h"
#include "prdp_experiments/data/data.h"
#include "prdp_experiments/data/flow_data.h"
#include "prdp_experiments/networks/resnet.h"
#include "prdp_experiments/networks/unet.h"
#include "prdp_experiments/scenes/scene.h"
#include "prdp_experiments/training/loss.h"

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

TEST(Scene, LearningRateFallsToATenthAsACosine) {
  const auto scene = prdp::read_scene(scene_path("navier_stokes"));
  EXPECT_DOUBLE_EQ(scene.learning_rate(0), 1e-3);
  EXPECT_NEAR(scene.learning_rate(200), 1e-3 * (0.55 + 0.45 * std::sqrt(0.5)), 1e-15);
  EXPECT_NEAR(scene.learning_rate(400), 0.55e-3, 1e-15);
  for (const int64_t update : {800, 1200}) EXPECT_NEAR(scene.learning_rate(update), 1e-4, 1e-15);
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

TEST(Data, SeriesInSpaceSumsEveryProductOfSinesAndCosines) {
  constexpr int64_t kSamples = 2, kModes = 3;
  const std::vector<int64_t> shape{3, 4, 5};  // z, y, x
  const auto u = prdp::fourier_series({"heat", shape}, kSamples, kModes, 9, at::kDouble);
  auto generator = prdp::make_generator(9);
  const auto drawn = at::rand({kSamples, 1, kModes, 8}, generator, at::TensorOptions(at::kDouble)) * 2.0 - 1.0;
  const auto wave = [&](int64_t axis, int64_t i, int64_t n, int64_t cosine) {
    const double angle = 2.0 * n * std::numbers::pi * static_cast<double>(i + 1) / static_cast<double>(shape[axis] + 1);
    return cosine ? std::cos(angle) : std::sin(angle);
  };
  auto expected = at::zeros_like(u);
  for (int64_t s = 0; s < kSamples; ++s)
    for (int64_t z = 0; z < shape[0]; ++z)
      for (int64_t y = 0; y < shape[1]; ++y)
        for (int64_t x = 0; x < shape[2]; ++x)
          for (int64_t n = 1; n <= kModes; ++n)
            for (int64_t p = 0; p < 8; ++p)
              expected[s][0][z][y][x] +=
                  drawn[s][0][n - 1][p] * wave(0, z, n, p & 1) * wave(1, y, n, p >> 1 & 1) * wave(2, x, n, p >> 2);
  EXPECT_TRUE(at::allclose(u, expected, 0.0, 1e-13));
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
  const auto data = prdp::compute_dataset(scene);
  EXPECT_EQ(data.train_start.sizes(), (std::vector<int64_t>{200, 1, 30}));
  EXPECT_EQ(data.valid_end.sizes(), (std::vector<int64_t>{5, 1, 30}));
  auto exact = scene.stepper(prdp::Direct{});
  EXPECT_TRUE(at::allclose(exact(exact(data.train_start)), data.train_end, 1e-5, 1e-6));
  EXPECT_TRUE(at::allclose(exact(exact(exact(data.valid_start))), data.valid_end, 1e-5, 1e-6));
  EXPECT_TRUE(at::equal(prdp::validation_trajectories(scene, 4).select(1, 3), data.valid_end));
  EXPECT_THROW(prdp::validation_trajectories(scene, -1), c10::ValueError);
  EXPECT_THROW(prdp::validation_trajectories(prdp::read_scene(scene_path("poisson_1p")), 1), c10::ValueError);
}

TEST(Data, RandomFlowIsNoiseSmoothedNormalisedAndProjected) {
  constexpr int64_t kSamples = 3, kNy = 9, kNx = 12, kN = kNy * kNx;
  const auto u = prdp::random_flow({kNy, kNx}, kSamples, 5);
  ASSERT_EQ(u.sizes(), (std::vector<int64_t>{kSamples, 3, kNy, kNx}));
  EXPECT_EQ(u.select(1, 2).abs().max().item<double>(), 0.0);
  EXPECT_LT(u.mean({-2, -1}).abs().max().item<double>(), 1e-14);

  // The same with matrices: a row of each is the operator applied to a unit field.
  const prdp::Grid grid("test", {kNy, kNx}, prdp::Boundary::kPeriodic);
  const auto eye = at::eye(kN, at::kDouble), units = eye.view({kN, 1, kNy, kNx});
  const auto smoothing = eye - 3e-3 * prdp::laplacian(units, grid).view({kN, kN});
  const auto dx = prdp::forward_difference(units, grid, 1).view({kN, kN});
  const auto dy = prdp::forward_difference(units, grid, 0).view({kN, kN});
  const auto divergence = at::cat({dx, dy});  // of a row (u₁, u₂) from the right
  EXPECT_LT(at::matmul(u.narrow(1, 0, 2).reshape({kSamples, 2 * kN}), divergence).abs().max().item<double>(), 1e-11);

  auto generator = prdp::make_generator(5);
  const auto noise = at::randn({kSamples, 2, kN}, generator, at::TensorOptions(at::kDouble));
  auto v = at::linalg_solve(smoothing, noise.mT()).mT();
  v = v - v.mean(-1, true);
  v = (v / v.std(at::IntArrayRef(-1), /*unbiased=*/false, /*keepdim=*/true)).reshape({kSamples, 2 * kN});
  const auto projected = v - at::matmul(v, at::matmul(divergence, at::linalg_pinv(divergence)));
  EXPECT_TRUE(at::allclose(u.narrow(1, 0, 2).reshape({kSamples, 2 * kN}), projected, 0.0, 1e-11));
}

TEST(Data, DownsamplingTakesEverySecondPoint) {
  const auto u = at::rand({2, 3, 7, 9}, at::kDouble), coarse = prdp::downsample(u);
  ASSERT_EQ(coarse.sizes(), (std::vector<int64_t>{2, 3, 3, 4}));
  for (int64_t j = 0; j < 3; ++j)
    for (int64_t i = 0; i < 4; ++i)
      EXPECT_TRUE(at::equal(coarse.select(3, i).select(2, j), u.select(3, 2 * i + 1).select(2, 2 * j + 1)));
}

TEST(Data, FlowsFollowTheConvergedReference) {
  auto scene = prdp::read_scene(scene_path("navier_stokes"));
  scene.physics.shape = {4, 3};
  scene.data = {0, 30, 2, 1, 3, {9, 7}, 0};
  scene.dtype = at::kDouble;
  int64_t calls = 0, last = 0;
  const auto data = prdp::compute_dataset(scene, [&](int64_t done, int64_t total) {
    EXPECT_EQ(total, 66);
    EXPECT_GT(done, last);
    last = done;
    ++calls;
  });
  EXPECT_EQ(calls, 2 * 2 + 3);
  EXPECT_EQ(last, 66);

  prdp::NavierStokes exact({9, 7}, scene.physics.nu, scene.physics.dt, prdp::Direct{});
  const auto start = prdp::random_flow({9, 7}, 32, 1), train = start.narrow(0, 0, 30), valid = start.narrow(0, 30, 2);
  const auto close = [](const at::Tensor& u, const at::Tensor& reference) {
    return at::allclose(u, prdp::downsample(reference), 0.0, 1e-6);
  };
  EXPECT_TRUE(close(data.train_start, train));
  EXPECT_TRUE(close(data.train_between.select(1, 0), exact(train)));
  EXPECT_TRUE(close(data.train_end, exact(exact(train))));
  EXPECT_TRUE(close(data.valid_start, valid));
  EXPECT_TRUE(close(data.valid_end, exact(exact(exact(valid)))));

  const auto further = prdp::validation_trajectories(scene, 4);
  ASSERT_EQ(further.sizes(), (std::vector<int64_t>{2, 5, 3, 4, 3}));
  EXPECT_TRUE(at::equal(further.select(1, 0), data.valid_start));
  EXPECT_TRUE(at::equal(further.select(1, 3), data.valid_end));
  EXPECT_TRUE(close(further.select(1, 4), exact(exact(exact(exact(valid))))));
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

TEST(UNet, HasTheParametersOfItsPythonTwin) {
  prdp::UNet network(2, 3, 2, 4, true);
  const auto parameters = network->named_parameters();
  EXPECT_EQ(parameters.size(), (3u + 2u) * 4u + 2u);
  EXPECT_EQ(parameters[0].key(), "down.0.0.weight");
  EXPECT_EQ(parameters[12].key(), "up.0.0.weight");
  EXPECT_EQ(parameters["up.0.0.weight"].sizes(), (std::vector<int64_t>{8, 16 + 8, 3, 3}));
  EXPECT_EQ(parameters["up.1.0.weight"].sizes(), (std::vector<int64_t>{4, 8 + 4, 3, 3}));
  EXPECT_EQ(parameters[21].key(), "project.bias");
  EXPECT_THROW(prdp::UNet(4, 1, 1, 1, true), c10::ValueError);
  EXPECT_THROW(network(at::zeros({1, 3, 8, 6})), c10::ValueError);
}

TEST(Loss, NormalisedErrorIsPerSample) {
  const auto reference = at::tensor({3.0, 4.0, 0.0, 1.0}).view({2, 1, 2});
  const auto u = at::tensor({3.0, 5.0, 0.0, 3.0}).view({2, 1, 2});
  EXPECT_NEAR(prdp::normalised_mse(u, reference).item<double>(), 0.5 * (1.0 / 25.0 + 4.0), 1e-6);
  EXPECT_NEAR(prdp::loss("mse", u, reference).item<double>(), 5.0 / 4.0, 1e-6);
  const auto flow = at::rand({2, 3, 4, 5}, at::kDouble), free = prdp::without_mean_pressure(flow);
  EXPECT_LT(free.select(1, 2).mean({-2, -1}).abs().max().item<double>(), 1e-15);
  EXPECT_TRUE(at::equal(free.narrow(1, 0, 2), flow.narrow(1, 0, 2)));
  EXPECT_THROW(prdp::loss("l1", u, reference), c10::ValueError);
}

}  // namespace
