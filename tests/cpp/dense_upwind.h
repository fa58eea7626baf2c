#pragma once
#include <Eigen/Dense>
#include <algorithm>
#include <random>
#include <vector>

#include "prdp/kernels/upwind_rows.h"

/// The upwind operators as dense matrices, made from their definitions in plain loops.
namespace prdp_test {

using Matrix = Eigen::MatrixXd;
using Vector = Eigen::VectorXd;

constexpr double kNu = 0.03, kDt = 0.2;

struct Shape {
  int64_t ny, nx;
};
template <class T>
std::vector<T> random_values(int64_t n, unsigned seed) {
  std::mt19937 generator(seed);
  std::normal_distribution<double> normal;
  std::vector<T> values(n);
  for (auto& value : values) value = static_cast<T>(normal(generator));
  return values;
}
template <class T>
Vector as_vector(const std::vector<T>& values) {
  using Values = Eigen::Matrix<T, Eigen::Dynamic, 1>;
  return Eigen::Map<const Values>(values.data(), values.size()).template cast<double>();
}

/// A grid whose neighbours go round the ends, and the fields u1 and u2 on it.
template <class T>
struct Flow {
  Shape shape;
  std::vector<T> values;

  int64_t cells() const { return shape.ny * shape.nx; }
  int64_t at(int64_t j, int64_t i) const { return (j + shape.ny) % shape.ny * shape.nx + (i + shape.nx) % shape.nx; }
  double u(int64_t channel, int64_t j, int64_t i) const {
    return static_cast<double>(values[channel * cells() + at(j, i)]);
  }
  prdp::kernels::UpwindParameters<T> parameters(bool transposed, int64_t dim = 2) const {
    const auto pattern = prdp::kernels::UpwindParameters<T>::of_grid(dim, shape.ny, shape.nx);
    return {values.data(), shape.ny, shape.nx, kNu, kDt, transposed, 1.0, 1.0, pattern};
  }
};
template <class T>
Flow<T> random_flow(Shape shape) {
  return {shape, random_values<T>(2 * shape.ny * shape.nx, 5)};
}

/// Adds scale·(max(before, 0) B + min(after, 0) F)/dx - diffusion·L to one row, along one axis.
inline void add_differences(Matrix& a, int64_t row, int64_t lower, int64_t upper, double n, double before, double after,
                            double scale, double diffusion) {
  const double backward = scale * std::max(before, 0.0) * n, forward = scale * std::min(after, 0.0) * n;
  a(row, row) += backward;
  a(row, lower) -= backward;
  a(row, upper) += forward;
  a(row, row) -= forward;
  a(row, row) += 2 * diffusion * n * n;
  a(row, lower) -= diffusion * n * n;
  a(row, upper) -= diffusion * n * n;
}

template <class T, int Dim>
Matrix dense_burgers(const Flow<T>& w) {
  const auto [ny, nx] = w.shape;
  Matrix a = Matrix::Identity(Dim * w.cells(), Dim * w.cells());
  for (int64_t c = 0; c < Dim; ++c)
    for (int64_t j = 0; j < ny; ++j)
      for (int64_t i = 0; i < nx; ++i) {
        const auto at = [&](int64_t dj, int64_t di) { return c * w.cells() + w.at(j + dj, i + di); };
        add_differences(a, at(0, 0), at(0, -1), at(0, 1), static_cast<double>(nx),
                        (w.u(0, j, i - 1) + w.u(0, j, i)) / 2, (w.u(0, j, i) + w.u(0, j, i + 1)) / 2, kDt, kNu * kDt);
        if (Dim == 1) continue;
        add_differences(a, at(0, 0), at(-1, 0), at(1, 0), static_cast<double>(ny),
                        (w.u(1, j - 1, i) + w.u(1, j, i)) / 2, (w.u(1, j, i) + w.u(1, j + 1, i)) / 2, kDt, kNu * kDt);
      }
  return a;
}

template <class T>
Matrix dense_navier_stokes(const Flow<T>& w) {
  const int64_t n = w.cells();
  const auto x = static_cast<double>(w.shape.nx), y = static_cast<double>(w.shape.ny);
  Matrix a = Matrix::Zero(3 * n, 3 * n);
  for (int64_t j = 0; j < w.shape.ny; ++j)
    for (int64_t i = 0; i < w.shape.nx; ++i) {
      const int64_t here = w.at(j, i);
      const double u2_at_u1 = (w.u(1, j, i - 1) + w.u(1, j, i) + w.u(1, j + 1, i - 1) + w.u(1, j + 1, i)) / 4;
      const double u1_at_u2 = (w.u(0, j - 1, i) + w.u(0, j, i) + w.u(0, j - 1, i + 1) + w.u(0, j, i + 1)) / 4;
      for (int64_t c = 0; c < 2; ++c) {
        const double along_x = c == 0 ? w.u(0, j, i) : u1_at_u2, along_y = c == 0 ? u2_at_u1 : w.u(1, j, i);
        a(c * n + here, c * n + here) += 1 / kDt;
        add_differences(a, c * n + here, c * n + w.at(j, i - 1), c * n + w.at(j, i + 1), x, along_x, along_x, 1.0, kNu);
        add_differences(a, c * n + here, c * n + w.at(j - 1, i), c * n + w.at(j + 1, i), y, along_y, along_y, 1.0, kNu);
      }
      a(here, 2 * n + here) += x;
      a(here, 2 * n + w.at(j, i - 1)) -= x;
      a(n + here, 2 * n + here) += y;
      a(n + here, 2 * n + w.at(j - 1, i)) -= y;
      a(2 * n + here, w.at(j, i + 1)) += x;
      a(2 * n + here, here) -= x;
      a(2 * n + here, n + w.at(j + 1, i)) += y;
      a(2 * n + here, n + here) -= y;
    }
  return a;
}

}  // namespace prdp_test
