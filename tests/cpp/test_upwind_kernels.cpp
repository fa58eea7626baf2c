#include <gtest/gtest.h>

#include "helpers.h"
#include "kernel_harness.h"
#include "prdp/kernels/burgers.h"
#include "prdp/kernels/navier_stokes_factors.h"
#include "prdp/solvers/solve_cpu.h"

/// The kernels of the upwind operators against dense matrices made from their definitions.
namespace {

using namespace prdp::kernels;
using namespace prdp_test;

const std::vector<Shape> kLines{{1, 1}, {1, 2}, {1, 3}, {1, 7}, {1, 16}, {1, 17}, {1, 33}};
const std::vector<Shape> kPlanes{{1, 1}, {2, 2}, {1, 4}, {4, 1}, {2, 16}, {3, 5}, {17, 9}, {5, 16}};

template <class T, int Dim>
void expect_burgers(Shape shape) {
  SCOPED_TRACE(testing::Message() << shape.ny << " x " << shape.nx << ", " << sizeof(T) << " bytes");
  const auto flow = random_flow<T>(shape);
  const Matrix a = dense_burgers<T, Dim>(flow);
  for (const bool transposed : {false, true}) {
    const auto kernel = burgers<T>(flow.parameters(transposed), Dim);
    const Matrix applied = transposed ? Matrix(a.transpose()) : a;
    expect_matrix(kernel, applied);
    expect_jacobi_sweep(kernel, applied);
    const auto lu = applied.partialPivLu();
    expect_solution(kernel, [&](const Vector& r) -> Vector { return lu.solve(r); });
  }
  expect_adjoint(burgers<T>(flow.parameters(false), Dim), burgers<T>(flow.parameters(true), Dim));
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
    const auto step = burgers<double>(flow.parameters(false), 2);
    const NavierStokes<double> flow_kernel(flow.parameters(true));
    EXPECT_FALSE(step.operator_is_finite());
    EXPECT_FALSE(flow_kernel.operator_is_finite());
    EXPECT_FALSE(std::isfinite(step.norm()));
    EXPECT_FALSE(std::isfinite(flow_kernel.norm()));
  }
}

/// Runs a method on a batch through the tensors' way into the loops.
template <class T, class Parameters>
at::Tensor solve_batch(const Parameters& a, const at::Tensor& b, prdp::Method method) {
  auto u = at::empty_like(b), residual = at::empty({b.size(0)}, b.options());
  std::vector<int64_t> iterations(b.size(0)), status(b.size(0)), applications(b.size(0));
  const prdp::SampleBatch<T> batch{method,
                                   500,
                                   1e-5,
                                   prdp::kDefaultRestart,
                                   nullptr,
                                   /*guarded=*/true,
                                   b.const_data_ptr<T>(),
                                   /*x0=*/nullptr,
                                   u.mutable_data_ptr<T>(),
                                   iterations.data(),
                                   residual.mutable_data_ptr<T>(),
                                   status.data(),
                                   applications.data()};
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
      const prdp::BurgersParameters advection{pairs, kNu, kDt, transposed};
      const prdp::NavierStokesParameters flow{w, kNu, kDt, transposed};
      const auto direct = solve_batch<float>(advection, flat, prdp::Method::kDirect);
      const auto jacobi = solve_batch<float>(advection, flat, prdp::Method::kJacobi);
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
