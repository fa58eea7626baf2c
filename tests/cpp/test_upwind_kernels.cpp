#include <gtest/gtest.h>

#include "dense_upwind.h"
#include "helpers.h"
#include "prdp/kernels/upwind_factors.h"
#include "prdp/solvers/solve_cpu.h"

/// The kernels of the upwind operators against dense matrices made from their definitions.
namespace {

using namespace prdp::kernels;
using namespace prdp_test;

const std::vector<Shape> kLines{{1, 1}, {1, 2}, {1, 3}, {1, 7}, {1, 16}, {1, 17}, {1, 33}};
const std::vector<Shape> kPlanes{{1, 1}, {2, 2}, {1, 4}, {4, 1}, {2, 16}, {3, 5}, {17, 9}, {5, 16}};

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
  const T squared =
      kernel.jacobi_sweep(harness.vector(0), harness.vector(1), harness.vector(2));
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
  EXPECT_NEAR(kernel.inconsistency(harness.vector(0)), std::abs(mean) * std::sqrt(17.0 * 9.0), 1e-14);
  kernel.project(harness.vector(0));
  EXPECT_LT((as_vector(harness.store(0)) - expected).norm(), 1e-14);
  EXPECT_LT(kernel.inconsistency(harness.vector(0)), 1e-14);
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

/// Runs a method on a batch through the tensors' way into the loops.
template <class T, class Parameters>
at::Tensor solve_batch(const Parameters& a, const at::Tensor& b, prdp::Method method) {
  auto u = at::empty_like(b), residual = at::empty({b.size(0)}, b.options());
  std::vector<int64_t> iterations(b.size(0)), status(b.size(0)), applications(b.size(0));
  const prdp::SampleBatch<T> batch{method, 500, 1e-5, prdp::kDefaultRestart, nullptr, true, b.const_data_ptr<T>(),
                                   u.mutable_data_ptr<T>(), iterations.data(), residual.mutable_data_ptr<T>(),
                                   status.data(), applications.data()};
  prdp::solve_range(a, batch, 0, b.size(0));
  return u;
}

TEST(UpwindKernels, ABatchIsSolvedWithItsOwnOrWithSharedWinds) {
  const Shape shape{3, 5};
  for (const int64_t winds : {1, 2})
    for (const bool transposed : {false, true}) {
      const auto w = prdp_test::random_field({3, 3, 5}, winds).squeeze(1).to(at::kFloat);
      const auto b = prdp_test::random_field({3, 3, 5}, 2).squeeze(1).to(at::kFloat).contiguous();
      const auto flat = b.narrow(1, 0, 2).contiguous();
      const auto pairs = w.narrow(1, 0, 2).contiguous();
      const prdp::BurgersParameters burgers{pairs, kNu, kDt, transposed};
      const prdp::NavierStokesParameters flow{w, kNu, kDt, transposed};
      const auto direct = solve_batch<float>(burgers, flat, prdp::Method::kDirect);
      const auto jacobi = solve_batch<float>(burgers, flat, prdp::Method::kJacobi);
      const auto step = solve_batch<float>(flow, b, prdp::Method::kDirect);
      EXPECT_LT((direct - jacobi).abs().max().item<float>(), 1e-4);
      for (int64_t s = 0; s < 2; ++s) {
        const float* values = pairs[winds == 1 ? 0 : s].const_data_ptr<float>();
        const Flow<float> sample{shape, {values, values + 30}};
        const auto expect_solved = [&](Matrix a, const at::Tensor& u, const at::Tensor& rhs) {
          if (transposed) a.transposeInPlace();
          using View = Eigen::Map<const Eigen::VectorXf>;
          const Vector x = View(u.const_data_ptr<float>(), a.rows()).cast<double>();
          Vector r = View(rhs.const_data_ptr<float>(), a.rows()).cast<double>();
          if (a.rows() == 45) r.tail(15).array() -= r.tail(15).mean();
          EXPECT_LT((a * x - r).norm(), 1e-4 * r.norm());
        };
        expect_solved(dense_burgers<float, 2>(sample), direct[s], flat[s]);
        expect_solved(dense_navier_stokes(sample), step[s], b[s]);
      }
    }
}

}  // namespace
