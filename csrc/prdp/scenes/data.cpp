#include "prdp/scenes/data.h"

#include <ATen/CPUGeneratorImpl.h>
#include <ATen/core/grad_mode.h>

#include <numbers>

namespace prdp {

at::Generator make_generator(int64_t seed) {
  return at::detail::createCPUGenerator(static_cast<uint64_t>(seed));
}

at::Tensor shuffled(int64_t samples, at::Generator& generator) {
  return at::randperm(samples, generator, at::TensorOptions().dtype(at::kLong));
}

at::Tensor fourier_series(const Grid& grid, int64_t samples, int64_t modes, int64_t seed,
                          at::ScalarType dtype) {
  auto generator = make_generator(seed);
  const int64_t dim = grid.dim(), products = int64_t{1} << dim;
  const auto real = at::TensorOptions().dtype(at::kDouble);
  const auto amplitude = at::rand({samples, modes, products}, generator, real) * 2.0 - 1.0;

  // wave[n·products + p]: the product whose axis d is a sine where bit d of p is 0, else a cosine.
  std::vector<at::Tensor> waves;
  for (int64_t n = 1; n <= modes; ++n)
    for (int64_t p = 0; p < products; ++p) {
      auto wave = at::ones({}, real);
      for (int64_t d = 0; d < dim; ++d) {
        const auto x = at::arange(1, grid.shape()[d] + 1, real) * grid.dx(d);
        const auto angle = x * (2.0 * std::numbers::pi * static_cast<double>(n));
        wave = wave.unsqueeze(-1) * ((p >> d) & 1 ? angle.cos() : angle.sin());
      }
      waves.push_back(wave.flatten());
    }
  const auto values = at::matmul(amplitude.reshape({samples, modes * products}), at::stack(waves));
  std::vector<int64_t> shape{samples, 1};
  shape.insert(shape.end(), grid.shape().begin(), grid.shape().end());
  return values.reshape(shape).to(dtype);
}

Dataset make_dataset(const Scene& scene) {
  const at::NoGradGuard no_grad;
  const Grid grid("data", scene.physics.shape);
  const auto& d = scene.data;
  const auto start = fourier_series(grid, d.train + d.valid, d.modes, d.seed, at::kDouble);
  auto converged = scene.stepper(Direct{});
  const auto end = converged(converged(start));
  const auto part = [&](const at::Tensor& t, int64_t from, int64_t count) {
    return t.narrow(0, from, count).to(scene.dtype).contiguous();
  };
  return {part(start, 0, d.train), part(end, 0, d.train), part(start, d.train, d.valid),
          part(end, d.train, d.valid)};
}

ParameterProblem make_parameter_problem(const Scene& scene) {
  const at::NoGradGuard no_grad;
  const auto real = at::TensorOptions().dtype(at::kDouble);
  const int64_t n = scene.physics.shape[0];
  const Grid grid("data", scene.physics.shape);
  const auto x = at::arange(1, n + 1, real) * grid.dx(0);
  std::vector<at::Tensor> sines;
  for (size_t i = 1; i <= scene.parameters.start.size(); ++i)
    sines.push_back((x * (2.0 * std::numbers::pi * static_cast<double>(i))).sin());
  const auto modes = at::stack(sines);
  const auto reference = at::tensor(scene.parameters.reference, real);
  const auto solution = scene.stepper(Direct{})(at::matmul(reference, modes).view({1, 1, n}));
  return {modes.to(scene.dtype), at::tensor(scene.parameters.start, real).to(scene.dtype),
          reference.to(scene.dtype), solution.to(scene.dtype)};
}

}  // namespace prdp
