#include <gtest/gtest.h>

#include "helpers.h"
#include "kernel_harness.h"
#include "prdp/kernels/burgers.h"
#include "prdp/kernels/navier_stokes.h"
#include "prdp/operators/operator.h"
#include "prdp/solvers/solve.h"

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
    const auto made = burgers<T>(flow.parameters(transposed, Dim), Dim);
    const Kernel<T>& kernel = *made;
    const Matrix applied = transposed ? Matrix(a.transpose()) : a;
    expect_matrix(kernel, applied);
    expect_jacobi_sweep(kernel, applied);
    const auto lu = applied.partialPivLu();
    expect_solution(kernel, [&](const Vector& r) -> Vector { return lu.solve(r); });
  }
  expect_adjoint(*burgers<T>(flow.parameters(false, Dim), Dim), *burgers<T>(flow.parameters(true, Dim), Dim));
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
    const NavierStokes<T> flow_kernel(flow.parameters(transposed));
    const Kernel<T>& kernel = flow_kernel;
    const Matrix applied = transposed ? Matrix(a.transpose()) : a;
    expect_matrix(kernel, applied);
    const auto lu = (applied + e * e.transpose()).partialPivLu();
    expect_solution(kernel, [&](const Vector& r) -> Vector { return lu.solve(r - e * e.dot(r)); });
  }
  expect_adjoint<T>(NavierStokes<T>(flow.parameters(false)), NavierStokes<T>(flow.parameters(true)));
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
  Harness<double> harness(kernel);
  const auto v = random_values<double>(kernel.unknowns(), 1);
  Vector expected = as_vector(v);
  const double mean = expected.tail(flow.cells()).mean();
  expected.tail(flow.cells()).array() -= mean;
  harness.load(v, 0);
  EXPECT_NEAR(kernel.null_space()->project(harness.vector(0)), std::abs(mean) * std::sqrt(17.0 * 9.0), 1e-13);
  EXPECT_LT((as_vector(harness.store(0)) - expected).norm(), 1e-14);
  EXPECT_LT(kernel.null_space()->project(harness.vector(0)), 1e-13);
  harness.expect_clean_padding(0);
}

TEST(UpwindKernels, WindsThatAreNotFiniteAreSeen) {
  for (const double bad : {std::nan(""), -HUGE_VAL}) {
    auto flow = random_flow<double>({3, 5});
    flow.values[29] = bad;
    EXPECT_EQ(burgers<double>(flow.parameters(false), 2), nullptr);
    EXPECT_EQ(navier_stokes<double>(flow.parameters(true)), nullptr);
  }
}

at::Tensor solve_batch(const prdp::OperatorSpec& spec, const at::Tensor& b, prdp::Method method) {
  return prdp::solve(*prdp::make_operator(spec), b, {{method, 500}}).u;
}

TEST(UpwindKernels, ABatchIsSolvedWithItsOwnOrWithSharedWinds) {
  const Shape shape{3, 5};
  for (const int64_t winds : {1, 2})
    for (const bool transposed : {false, true}) {
      const auto w = prdp_test::random_field({3, 3, 5}, winds).squeeze(1).to(at::kFloat);
      const auto b = prdp_test::random_field({3, 3, 5}, 2).squeeze(1).to(at::kFloat).contiguous();
      const auto flat = b.narrow(1, 0, 2).contiguous();
      const auto pairs = w.narrow(1, 0, 2).contiguous();
      const auto nu = at::scalar_tensor(kNu, at::kDouble);
      const prdp::OperatorSpec advection{"burgers", {3, 5}, {kDt}, {pairs, nu}, transposed};
      const prdp::OperatorSpec flow{"navier_stokes", {3, 5}, {kDt}, {w, nu}, transposed};
      const auto direct = solve_batch(advection, flat, prdp::Method::kDirect);
      const auto jacobi = solve_batch(advection, flat, prdp::Method::kJacobi);
      const auto step = solve_batch(flow, b, prdp::Method::kDirect);
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
