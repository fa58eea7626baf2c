#include <gtest/gtest.h>

#include <Eigen/Dense>
#include <random>

#include "prdp/kernels/upwind_factors.h"

/// The kernels of the upwind operators against dense matrices made from their definitions.
namespace {

using namespace prdp::kernels;
using Matrix = Eigen::MatrixXd;
using Vector = Eigen::VectorXd;

constexpr double kNu = 0.03, kDt = 0.2;

struct Shape {
  int64_t ny, nx;
};
const std::vector<Shape> kLines{{1, 1}, {1, 2}, {1, 3}, {1, 7}, {1, 16}, {1, 17}, {1, 33}};
const std::vector<Shape> kPlanes{{1, 1}, {2, 2}, {1, 4}, {4, 1}, {2, 16}, {3, 5}, {17, 9}, {5, 16}};

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
  return Eigen::Map<const Eigen::Matrix<T, Eigen::Dynamic, 1>>(values.data(), values.size()).template cast<double>();
}

/// A grid whose neighbours go round the ends, and the fields u1 and u2 on it.
template <class T>
struct Flow {
  Shape shape;
  std::vector<T> values;

  int64_t cells() const { return shape.ny * shape.nx; }
  int64_t at(int64_t j, int64_t i) const {
    return (j + shape.ny) % shape.ny * shape.nx + (i + shape.nx) % shape.nx;
  }
  double u(int64_t channel, int64_t j, int64_t i) const {
    return static_cast<double>(values[channel * cells() + at(j, i)]);
  }
  UpwindParameters<T> parameters(bool transposed) const {
    return {values.data(), 0, shape.ny, shape.nx, kNu, kDt, transposed};
  }
};
template <class T>
Flow<T> random_flow(Shape shape) {
  return {shape, random_values<T>(2 * shape.ny * shape.nx, 5)};
}

/// Adds scale·(max(before, 0) B + min(after, 0) F)/dx - diffusion·L to one row, along one axis.
void add_differences(Matrix& a, int64_t row, int64_t lower, int64_t upper, double n, double before,
                     double after, double scale, double diffusion) {
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
                        (w.u(0, j, i - 1) + w.u(0, j, i)) / 2, (w.u(0, j, i) + w.u(0, j, i + 1)) / 2, kDt,
                        kNu * kDt);
        if (Dim == 1) continue;
        add_differences(a, at(0, 0), at(-1, 0), at(1, 0), static_cast<double>(ny),
                        (w.u(1, j - 1, i) + w.u(1, j, i)) / 2, (w.u(1, j, i) + w.u(1, j + 1, i)) / 2, kDt,
                        kNu * kDt);
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
        add_differences(a, c * n + here, c * n + w.at(j, i - 1), c * n + w.at(j, i + 1), x, along_x, along_x,
                        1.0, kNu);
        add_differences(a, c * n + here, c * n + w.at(j - 1, i), c * n + w.at(j + 1, i), y, along_y, along_y,
                        1.0, kNu);
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

/// A kernel's operations on plain vectors, in padded memory as the solvers use it.
template <class Kernel>
class Harness {
 public:
  using T = typename Kernel::Scalar;

  explicit Harness(const Kernel& kernel) : kernel_(kernel) {
    workspace_.prepare(3, kernel.length(), kernel.halo());
  }
  T* vector(int64_t index) { return workspace_.vector(index); }
  void load(const std::vector<T>& v, int64_t index) { kernel_.load(v.data(), T(1), vector(index)); }
  std::vector<T> store(int64_t index) {
    std::vector<T> values(kernel_.unknowns());
    kernel_.store(vector(index), T(1), values.data());
    return values;
  }
  std::vector<T> apply(const std::vector<T>& v) {
    load(v, 0);
    kernel_.apply(vector(0), vector(1));
    return store(1);
  }
  /// Nothing but the unknowns is other than zero.
  void expect_clean_padding(int64_t index) {
    const Vector inside = as_vector(store(index));
    double all = 0;
    for (int64_t i = -kernel_.halo(); i < kernel_.length() + kernel_.halo(); ++i)
      all += vector(index)[i] != T(0);
    EXPECT_EQ(static_cast<double>((inside.array() != 0).count()), all);
  }

 private:
  const Kernel& kernel_;
  Workspace<T> workspace_;
};

template <class T>
constexpr double kTolerance = sizeof(T) == 4 ? 1e-6 : 1e-14;

template <class Kernel>
void expect_matrix(const Kernel& kernel, const Matrix& a) {
  using T = typename Kernel::Scalar;
  ASSERT_EQ(kernel.unknowns(), a.rows());
  Harness<Kernel> harness(kernel);
  const auto v = random_values<T>(kernel.unknowns(), 11);
  const double norm = a.cwiseAbs().rowwise().sum().maxCoeff();
  EXPECT_LT((as_vector(harness.apply(v)) - a * as_vector(v)).cwiseAbs().maxCoeff(), 8 * kTolerance<T> * norm);
  harness.expect_clean_padding(1);
  EXPECT_NEAR(kernel.norm(), norm, 8 * kTolerance<T> * norm);
  EXPECT_EQ(kernel.has_zero_diagonal(), (a.diagonal().array() == 0.0).any());

  Matrix entries = Matrix::Zero(a.rows(), a.cols());
  const int64_t block = std::is_same_v<Kernel, Burgers<T, 2>> ? a.rows() / 2 : a.rows();
  kernel.for_each_entry([&](int64_t i, int64_t j, T value) { entries(i, j) += static_cast<double>(value); });
  EXPECT_LT((entries - a).topLeftCorner(block, block).cwiseAbs().maxCoeff(), 8 * kTolerance<T> * norm);
}

template <class Kernel>
void expect_jacobi_sweep(const Kernel& kernel, const Matrix& a) {
  using T = typename Kernel::Scalar;
  Harness<Kernel> harness(kernel);
  const auto b = random_values<T>(kernel.unknowns(), 2), x = random_values<T>(kernel.unknowns(), 3);
  harness.load(b, 2);
  kernel.divide_by_diagonal(harness.vector(2), harness.vector(0));
  harness.load(x, 1);
  const T squared = kernel.template jacobi_sweep<true>(harness.vector(0), harness.vector(1), harness.vector(2));
  const Vector residual = as_vector(b) - a * as_vector(x);
  const Vector next = as_vector(x) + residual.cwiseQuotient(a.diagonal());
  const double scale = 30 * kTolerance<T>;
  EXPECT_LT((as_vector(harness.store(2)) - next).norm(), scale * (1 + next.norm()));
  EXPECT_NEAR(static_cast<double>(squared), residual.squaredNorm(), scale * a.squaredNorm());
  harness.expect_clean_padding(0);
  harness.expect_clean_padding(2);
}

/// `expected`: what the factors must give for the right-hand side of as many random values.
template <class Kernel>
void expect_solution(const Kernel& kernel, const std::function<Vector(const Vector&)>& expected) {
  using T = typename Kernel::Scalar;
  const typename FactorsOf<Kernel>::Type factors(kernel);
  Harness<Kernel> harness(kernel);
  for (const unsigned seed : {21u, 22u}) {
    const auto r = random_values<T>(kernel.unknowns(), seed);
    harness.load(r, 0);
    ASSERT_TRUE(factors.solve(harness.vector(0), harness.vector(1)));
    const Vector x = expected(as_vector(r));
    EXPECT_LT((as_vector(harness.store(1)) - x).norm(), 1e3 * kTolerance<T> * (1 + x.norm()));
    harness.expect_clean_padding(1);
  }
}

template <class Kernel, class T = typename Kernel::Scalar>
void expect_adjoint(const Kernel& a, const Kernel& transpose) {
  Harness<Kernel> forward(a), backward(transpose);
  const auto x = random_values<T>(a.unknowns(), 7), y = random_values<T>(a.unknowns(), 8);
  const Vector ax = as_vector(forward.apply(x)), aty = as_vector(backward.apply(y));
  const double scale = ax.norm() * as_vector(y).norm() + aty.norm() * as_vector(x).norm();
  EXPECT_NEAR(ax.dot(as_vector(y)), aty.dot(as_vector(x)), 4 * kTolerance<T> * scale);
}

template <class T, int Dim>
void expect_burgers(Shape shape) {
  SCOPED_TRACE(testing::Message() << shape.ny << " x " << shape.nx << ", " << sizeof(T) << " bytes");
  const auto flow = random_flow<T>(shape);
  const Matrix a = dense_burgers<T, Dim>(flow);
  for (const bool transposed : {false, true}) {
    const Burgers<T, Dim> kernel(flow.parameters(transposed));
    const Matrix applied = transposed ? Matrix(a.transpose()) : a;
    expect_matrix(kernel, applied);
    expect_jacobi_sweep(kernel, applied);
    const auto lu = applied.partialPivLu();
    expect_solution(kernel, [&](const Vector& r) -> Vector { return lu.solve(r); });
  }
  expect_adjoint(Burgers<T, Dim>(flow.parameters(false)), Burgers<T, Dim>(flow.parameters(true)));
}

template <class T>
void expect_navier_stokes(Shape shape) {
  SCOPED_TRACE(testing::Message() << shape.ny << " x " << shape.nx << ", " << sizeof(T) << " bytes");
  const auto flow = random_flow<T>(shape);
  const Matrix a = dense_navier_stokes(flow);
  // The constant pressure e spans the null spaces of A and Aᵀ: A + eeᵀ gives the minimum-norm solution
  // wherever r has no part in e.
  Vector e = Vector::Zero(a.rows());
  e.tail(flow.cells()).setConstant(1 / std::sqrt(static_cast<double>(flow.cells())));
  ASSERT_LT((a * e).norm() + (a.transpose() * e).norm(), 1e-10);
  for (const bool transposed : {false, true}) {
    const NavierStokes<T> kernel(flow.parameters(transposed));
    const Matrix applied = transposed ? Matrix(a.transpose()) : a;
    expect_matrix(kernel, applied);
    const auto lu = (applied + e * e.transpose()).partialPivLu();
    expect_solution(kernel, [&](const Vector& r) -> Vector { return lu.solve(r - e * e.dot(r)); });
  }
  expect_adjoint(NavierStokes<T>(flow.parameters(false)), NavierStokes<T>(flow.parameters(true)));
}

TEST(UpwindKernels, BurgersEqualsItsMatrixInOneDimension) {
  for (const Shape shape : kLines) {
    expect_burgers<float, 1>(shape);
    expect_burgers<double, 1>(shape);
  }
}

TEST(UpwindKernels, BurgersEqualsItsMatrixInTwoDimensions) {
  for (const Shape shape : kPlanes) {
    expect_burgers<float, 2>(shape);
    expect_burgers<double, 2>(shape);
  }
}

TEST(UpwindKernels, NavierStokesEqualsItsMatrix) {
  for (const Shape shape : kPlanes) {
    expect_navier_stokes<float>(shape);
    expect_navier_stokes<double>(shape);
  }
}

TEST(UpwindKernels, NavierStokesProjectsThePressureAlone) {
  const auto flow = random_flow<double>({17, 9});
  const NavierStokes<double> kernel(flow.parameters(false));
  Harness<NavierStokes<double>> harness(kernel);
  const auto v = random_values<double>(kernel.unknowns(), 1);
  Vector expected = as_vector(v);
  const double mean = expected.tail(flow.cells()).mean();
  expected.tail(flow.cells()).array() -= mean;
  harness.load(v, 0);
  EXPECT_NEAR(kernel.inconsistency(harness.vector(0)), std::abs(mean), 1e-15);
  kernel.project(harness.vector(0));
  EXPECT_LT((as_vector(harness.store(0)) - expected).norm(), 1e-14);
  EXPECT_LT(kernel.inconsistency(harness.vector(0)), 1e-15);
  harness.expect_clean_padding(0);
}

TEST(UpwindKernels, EachSampleHasItsOwnWinds) {
  const Shape shape{3, 5};
  // Three channels a sample, as a whole state (u1, u2, p) has them.
  const auto states = random_values<float>(2 * 3 * 15, 4);
  const NavierStokes<float> both({states.data(), 3 * 15, 3, 5, kNu, kDt, false});
  EXPECT_FALSE(both.is_shared());
  for (int64_t s = 0; s < 2; ++s) {
    const Flow<float> flow{shape, {states.begin() + s * 45, states.begin() + s * 45 + 30}};
    expect_matrix(both.sample(s), dense_navier_stokes(flow));
  }
}

TEST(UpwindKernels, WindsThatAreNotFiniteAreSeen) {
  for (const double bad : {std::nan(""), -HUGE_VAL}) {
    auto flow = random_flow<double>({3, 5});
    flow.values[29] = bad;
    const Burgers<double, 2> burgers(flow.parameters(false));
    const NavierStokes<double> flow_kernel(flow.parameters(true));
    EXPECT_FALSE(burgers.operator_is_finite());
    EXPECT_FALSE(flow_kernel.operator_is_finite());
    EXPECT_FALSE(std::isfinite(burgers.norm()));
    EXPECT_FALSE(std::isfinite(flow_kernel.norm()));
  }
}

template <class T>
void expect_sums_over_vectors() {
  for (const int64_t n : {0, 1, 15, 16, 17, 64, 272})
    for (int64_t count = 0; count <= 19; ++count) {
      SCOPED_TRACE(testing::Message() << count << " vectors of " << n);
      std::vector<std::vector<T>> vectors;
      std::vector<const T*> v;
      for (int64_t j = 0; j < count; ++j) vectors.push_back(random_values<T>(n, 100 + static_cast<unsigned>(j)));
      for (const auto& vector : vectors) v.push_back(vector.data());
      auto w = random_values<T>(n, 1);
      const auto alpha = random_values<T>(count, 2);
      std::vector<T> h(count + 1, T(7));
      loops<T>().multi_dot(v.data(), count, w.data(), h.data(), n);
      Vector expected = as_vector(w);
      for (int64_t j = 0; j < count; ++j) {
        EXPECT_NEAR(h[j], as_vector(vectors[j]).dot(as_vector(w)), 100 * kTolerance<T>);
        expected -= static_cast<double>(alpha[j]) * as_vector(vectors[j]);
      }
      EXPECT_EQ(h[count], T(7));
      loops<T>().multi_axpy(alpha.data(), v.data(), count, w.data(), n);
      EXPECT_LT((as_vector(w) - expected).norm(), 100 * kTolerance<T>);
    }
}
TEST(Vector, SumsOverManyVectorsEqualSumsOverEach) {
  expect_sums_over_vectors<float>();
  expect_sums_over_vectors<double>();
}

}  // namespace
