#include <gtest/gtest.h>

#include "kernel_harness.h"
#include "prdp/kernels/given_stencil.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/solvers/solve.h"

/// The kernel of stencils given by their coefficients against dense matrices made from the definition.
namespace {

using namespace prdp::kernels;
using namespace prdp_test;

const std::vector<Offset> kFar{{{0, 0, 0}}, {{0, 0, -2}}, {{0, 2, 1}}, {{0, -1, 0}}, {{0, -2, 2}}, {{0, 0, 1}}};
const std::vector<Offset> kFarInSpace{{{0, 0, 0}}, {{2, 0, -1}}, {{-1, 1, 2}}, {{0, -2, 0}}, {{-2, 0, 0}}};

/// The matrix on one channel.
template <class T>
Matrix dense_stencil(const StencilGrid& grid, const std::vector<Offset>& offsets, const std::vector<T>& coefficients) {
  const auto& [nz, ny, nx] = grid.shape;
  const int64_t n = nz * ny * nx;
  Matrix a = Matrix::Zero(n, n);
  for (size_t k = 0; k < offsets.size(); ++k)
    for (int64_t row = 0; row < n; ++row) {
      int64_t at[3] = {row / nx / ny, row / nx % ny, row % nx};
      bool inside = true;
      for (int d = 0; d < 3; ++d) {
        at[d] += offsets[k].along[d];
        inside = inside && (grid.periodic[d] || (at[d] >= 0 && at[d] < grid.shape[d]));
        at[d] = (at[d] + 2 * grid.shape[d]) % grid.shape[d];
      }
      if (inside) a(row, (at[0] * ny + at[1]) * nx + at[2]) += static_cast<double>(coefficients[k * n + row]);
    }
  return a;
}

/// Diagonally dominant by rows.
template <class T>
std::vector<T> random_coefficients(int64_t points, size_t count) {
  auto c = random_values<T>(points * static_cast<int64_t>(count), 9);
  for (int64_t i = 0; i < points; ++i) {
    T sum = 1;
    for (size_t k = 1; k < count; ++k) sum += std::abs(c[k * points + i]);
    c[i] = i % 2 ? sum : -sum;
  }
  return c;
}

template <class T>
std::unique_ptr<Kernel<T>> make_kernel(const StencilGrid& grid, std::vector<Offset> offsets,
                                       const std::vector<T>& coefficients, int64_t channels, bool transposed) {
  if (transposed)
    for (auto& offset : offsets)
      for (auto& cells : offset.along) cells = -cells;
  return GivenStencil<T>{coefficients.data(), 0, std::make_shared<StencilSparsity>(grid, offsets), transposed}.make(
      0, channels);
}

template <class T>
void expect_stencil(const StencilGrid& grid, const std::vector<Offset>& offsets) {
  const auto& [nz, ny, nx] = grid.shape;
  SCOPED_TRACE(testing::Message() << nz << " x " << ny << " x " << nx << ", periodic " << grid.periodic[0]
                                  << grid.periodic[1] << grid.periodic[2] << ", " << offsets.size() << " offsets of "
                                  << sizeof(T) << " bytes");
  const auto c = random_coefficients<T>(nz * ny * nx, offsets.size());
  const Matrix block = dense_stencil(grid, offsets, c);
  for (const int64_t channels : {1, 2}) {
    Matrix a = Matrix::Zero(channels * block.rows(), channels * block.rows());
    for (int64_t i = 0; i < channels; ++i)
      a.block(i * block.rows(), i * block.rows(), block.rows(), block.rows()) = block;
    for (const bool transposed : {false, true}) {
      const auto made = make_kernel(grid, offsets, c, channels, transposed);
      const Kernel<T>& kernel = *made;
      const Matrix applied = transposed ? Matrix(a.transpose()) : a;
      expect_matrix(kernel, applied);
      if (!kernel.has_zero_diagonal()) expect_jacobi_sweep(kernel, applied);
      const auto lu = applied.partialPivLu();
      if (std::abs(block.determinant()) > 1e-3)
        expect_solution(kernel, [&](const Vector& r) -> Vector { return lu.solve(r); });

      Harness<T> harness(kernel);
      const auto v = random_values<T>(kernel.unknowns(), 4);
      harness.load(v, 0);
      const auto [v_out, out_out] = kernel.apply_with_dots(harness.vector(0), harness.vector(1));
      const Vector product = applied * as_vector(v);
      const double scale = 60 * kTolerance<T> * (1 + product.squaredNorm());
      EXPECT_NEAR(static_cast<double>(v_out), product.dot(as_vector(v)), scale);
      EXPECT_NEAR(static_cast<double>(out_out), product.squaredNorm(), scale);
      harness.expect_clean_padding(1);
    }
    expect_adjoint(*make_kernel(grid, offsets, c, channels, false), *make_kernel(grid, offsets, c, channels, true));
  }
}

void expect_stencils(int64_t dim, const std::vector<std::array<int64_t, 3>>& shapes, const std::vector<Offset>& far) {
  for (const auto& n : shapes)
    for (int boundary = 0; boundary < 1 << dim; ++boundary) {
      const StencilGrid grid{dim, {n[0], n[1], n[2]}, {(boundary & 4) != 0, (boundary & 2) != 0, (boundary & 1) != 0}};
      for (const auto& offsets : {StencilSparsity::nearest_neighbours(dim), far}) {
        expect_stencil<float>(grid, offsets);
        expect_stencil<double>(grid, offsets);
      }
    }
}

TEST(StencilKernel, EqualsItsMatrixInOneDimension) {
  expect_stencils(1, {{1, 1, 1}, {1, 1, 2}, {1, 1, 3}, {1, 1, 4}, {1, 1, 16}, {1, 1, 17}, {1, 1, 33}},
                  {{{0, 0, 0}}, {{0, 0, -1}}, {{0, 0, 1}}, {{0, 0, 2}}, {{0, 0, -2}}});
}
TEST(StencilKernel, EqualsItsMatrixInTwoDimensions) {
  expect_stencils(2, {{1, 1, 1}, {1, 2, 2}, {1, 4, 1}, {1, 3, 5}, {1, 5, 16}, {1, 2, 17}}, kFar);
}
TEST(StencilKernel, EqualsItsMatrixInThreeDimensions) {
  expect_stencils(3, {{1, 1, 1}, {2, 1, 3}, {3, 2, 4}, {2, 3, 17}}, kFarInSpace);
}

/// Whether the neighbour of a point is there.
bool is_there(const StencilGrid& grid, int64_t point, const Offset& offset) {
  const auto& [nz, ny, nx] = grid.shape;
  const int64_t at[3] = {point / nx / ny, point / nx % ny, point % nx};
  for (int d = 0; d < 3; ++d)
    if (neighbour(at[d], offset.along[d], grid.shape[d], grid.periodic[d]) < 0) return false;
  return true;
}

/// Points that are coupled to their neighbours a million times as strongly as they are held.
template <class T>
void expect_held(const StencilGrid& grid, bool is_number) {
  SCOPED_TRACE(testing::Message() << grid.shape[0] << " x " << grid.shape[1] << " x " << grid.shape[2] << ", periodic "
                                  << grid.periodic[0] << grid.periodic[1] << grid.periodic[2] << ", " << sizeof(T)
                                  << " bytes, held by a number: " << is_number);
  const int64_t n = grid.shape[0] * grid.shape[1] * grid.shape[2], channels = 2;
  const auto offsets = StencilSparsity::nearest_neighbours(grid.dim);
  auto held = random_values<T>(is_number ? 1 : n, 10), c = random_values<T>(n * std::ssize(offsets), 9);
  for (auto& h : held) h = T(1e-6) * (1 + std::abs(h));
  std::vector<double> exact(c.size());
  for (int64_t i = 0; i < n; ++i) {
    exact[i] = static_cast<double>(held[is_number ? 0 : i]);
    for (int64_t k = 1; k < std::ssize(offsets); ++k) {
      c[k * n + i] = is_there(grid, i, offsets[k]) ? -std::abs(c[k * n + i]) : T(0);
      exact[k * n + i] = static_cast<double>(c[k * n + i]);
      exact[i] -= exact[k * n + i];
    }
    c[i] = static_cast<T>(exact[i]);
  }
  const auto made =
      GivenStencil<T>{c.data(), 0, std::make_shared<StencilSparsity>(grid, offsets), false, {held.data(), 0, is_number}}
          .make(0, channels);
  const Matrix block = dense_stencil(grid, offsets, exact);
  Matrix a = Matrix::Zero(channels * n, channels * n);
  for (int64_t i = 0; i < channels; ++i) a.block(i * n, i * n, n, n) = block;
  expect_matrix(*made, a);
  expect_jacobi_sweep(*made, a);
  const auto lu = a.partialPivLu();  // in double, so that it says nothing of factors in double
  if (sizeof(T) == 4) expect_solution(*made, [&](const Vector& r) -> Vector { return lu.solve(r); });

  Harness<T> harness(*made);
  const auto of_ones = harness.apply(std::vector<T>(channels * n, T(1)));
  for (int64_t i = 0; i < channels * n; ++i) EXPECT_EQ(of_ones[i], held[is_number ? 0 : i % n]);
  Vector rows = Vector::Zero(n);
  for_each_entry(*made, [&](int64_t i, int64_t, double value) { rows[i] += value; });
  for (int64_t i = 0; i < n; ++i) EXPECT_NEAR(rows[i], held[is_number ? 0 : i], 1e-14);
}

TEST(StencilKernel, KeepsWhatHoldsItsPointsBesideAnyCoupling) {
  const std::vector<std::pair<int64_t, std::array<int64_t, 3>>> grids{{1, {1, 1, 2}},  {1, {1, 1, 3}}, {1, {1, 1, 16}},
                                                                      {1, {1, 1, 33}}, {2, {1, 2, 2}}, {2, {1, 3, 5}},
                                                                      {2, {1, 5, 17}}, {3, {2, 2, 3}}, {3, {3, 2, 17}}};
  for (const auto& [dim, n] : grids)
    for (int boundary = 0; boundary < 1 << dim; ++boundary)
      for (const bool is_number : {true, false}) {
        const StencilGrid grid{
            dim, {n[0], n[1], n[2]}, {(boundary & 4) != 0, (boundary & 2) != 0, (boundary & 1) != 0}};
        expect_held<float>(grid, is_number);
        expect_held<double>(grid, is_number);
      }
}

TEST(StencilSparsity, OffsetsThatLeadToOneNeighbourAreOne) {
  const std::vector<Offset> five{{{0, 0, -2}}, {{0, 0, -1}}, {{0, 0, 0}}, {{0, 0, 1}}, {{0, 0, 2}}};
  const auto places = [&](int64_t n, bool periodic) {
    return StencilSparsity({1, {1, 1, n}, {false, false, periodic}}, five).places;
  };
  using Places = std::vector<int64_t>;
  EXPECT_EQ(places(1, true), (Places{0, 0, 0, 0, 0}));
  EXPECT_EQ(places(2, true), (Places{0, 2, 0, 2, 0}));
  EXPECT_EQ(places(3, true), (Places{2, 1, 0, 2, 1}));
  EXPECT_EQ(places(4, true), (Places{1, 2, 0, 3, 1}));
  EXPECT_EQ(places(1, false), (Places{-1, -1, 0, -1, -1}));
  EXPECT_EQ(places(2, false), (Places{-1, 1, 0, 2, -1}));
  EXPECT_TRUE(StencilSparsity({1, {1, 1, 3}, {false, false, true}}, five).nearest);
  EXPECT_FALSE(StencilSparsity({1, {1, 1, 4}, {false, false, true}}, five).nearest);
}

TEST(Stencil, KnowsItsNormWhereNeighboursCoincide) {
  for (const std::vector<int64_t>& n : {std::vector<int64_t>{1, 2}, {2, 3}, {4, 3}, {5, 6}})
    for (const auto boundary : {prdp::Boundary::kDirichlet, prdp::Boundary::kPeriodic}) {
      auto c = random_values<double>(6 * n[0] * n[1], 3);
      const auto coefficients = at::from_blob(c.data(), {1, 6, n[0], n[1]}, at::kDouble);
      std::vector<std::vector<int64_t>> offsets;
      for (const auto& o : kFar) offsets.push_back({o.along[1], o.along[2]});
      const auto a = prdp::make_operator(prdp::stencil(coefficients, offsets, {boundary}));
      const bool periodic = boundary == prdp::Boundary::kPeriodic;
      const Matrix m = dense_stencil<double>({2, {1, n[0], n[1]}, {true, periodic, periodic}}, kFar, c);
      EXPECT_NEAR(a->norm().item<double>(), m.cwiseAbs().rowwise().sum().maxCoeff(), 1e-12);
      c[7] = std::nan("");
      EXPECT_TRUE(std::isnan(a->norm().item<double>()));
    }
}

TEST(Stencil, IsAnOperatorOfTheLibrary) {
  const auto c = at::cat({at::full({1, 1, 4}, 3.0, at::kDouble), at::full({1, 1, 4}, -1.0, at::kDouble)}, 1);
  const auto spec = prdp::stencil(c, {{0}, {-1}}, {prdp::Boundary::kPeriodic});
  const auto a = prdp::make_operator(spec);
  const auto matrix = 3.0 * at::eye(4, at::kDouble) - at::eye(4, at::kDouble).roll(1, 0);
  EXPECT_TRUE(at::allclose(a->dense(c.options()), matrix));
  const auto b = at::arange(1, 9, at::kDouble).view({1, 2, 4});
  const auto u = prdp::solve(*a, b, {{prdp::Method::kDirect, 1, 0.0}}).u;
  EXPECT_TRUE(at::allclose(at::matmul(u, matrix.mT()), b));
  EXPECT_THROW(prdp::stencil(c, {{0}}), c10::ValueError);
  EXPECT_THROW(prdp::stencil(c, {{0}, {3}}), c10::ValueError);
  EXPECT_THROW(prdp::stencil(c, {{0}, {0, 1}}), c10::ValueError);
  EXPECT_THROW(prdp::stencil(c, {{0}, {1}}, {prdp::Boundary::kPeriodic, prdp::Boundary::kPeriodic}), c10::ValueError);
}

}  // namespace
