#pragma once
#include <gtest/gtest.h>

#include <functional>

#include "dense_upwind.h"
#include "prdp/kernels/navier_stokes.h"
#include "prdp/kernels/stencil.h"

/// What every kernel on padded rows must do, held against a dense matrix.
namespace prdp_test {

using namespace prdp::kernels;

/// A kernel's operations on plain vectors, in padded memory as the solvers use it.
template <class T>
class Harness {
 public:
  explicit Harness(const Kernel<T>& kernel) : kernel_(kernel) {
    workspace_.prepare(3, kernel.length(), kernel.layout().halo);
  }
  T* vector(int64_t index) { return workspace_.vector(index); }
  void load(const std::vector<T>& v, int64_t index) { kernel_.layout().load(v.data(), T(1), vector(index)); }
  std::vector<T> store(int64_t index) {
    std::vector<T> values(kernel_.unknowns());
    kernel_.layout().store(vector(index), T(1), values.data());
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
    const int64_t halo = kernel_.layout().halo;
    for (int64_t i = -halo; i < kernel_.length() + halo; ++i) all += vector(index)[i] != T(0);
    EXPECT_EQ(static_cast<double>((inside.array() != 0).count()), all);
  }

 private:
  const Kernel<T>& kernel_;
  Workspace<T> workspace_;
};

template <class T>
constexpr double kTolerance = sizeof(T) == 4 ? 1e-6 : 1e-14;

/// Entries of the block that a kernel's channels share, or of all of it.
template <class T, class Body>
void for_each_entry(const Kernel<T>& kernel, const Body& body) {
  if (const auto* stencil = dynamic_cast<const Stencil<T>*>(&kernel)) stencil->coefficients().for_each_entry(body);
  else dynamic_cast<const NavierStokes<T>&>(kernel).for_each_entry(body);
}

template <class T>
void expect_matrix(const Kernel<T>& kernel, const Matrix& a) {
  ASSERT_EQ(kernel.unknowns(), a.rows());
  ASSERT_EQ(kernel.factor(), T(1));
  Harness<T> harness(kernel);
  const auto v = random_values<T>(kernel.unknowns(), 11);
  const double norm = a.cwiseAbs().rowwise().sum().maxCoeff();
  EXPECT_LT((as_vector(harness.apply(v)) - a * as_vector(v)).cwiseAbs().maxCoeff(), 8 * kTolerance<T> * norm);
  harness.expect_clean_padding(1);
  EXPECT_NEAR(kernel.norm(), norm, 8 * kTolerance<T> * norm);
  EXPECT_EQ(kernel.has_zero_diagonal(), (a.diagonal().array() == 0.0).any());

  Matrix entries = Matrix::Zero(a.rows(), a.cols());
  const auto add = [&](int64_t i, int64_t j, T value) { entries(i, j) += static_cast<double>(value); };
  for_each_entry(kernel, add);
  const bool of_channels = dynamic_cast<const Stencil<T>*>(&kernel) != nullptr;
  const int64_t block = a.rows() / (of_channels ? kernel.layout().planes : 1);
  EXPECT_LT((entries - a).topLeftCorner(block, block).cwiseAbs().maxCoeff(), 8 * kTolerance<T> * norm);
}

template <class T>
void expect_jacobi_sweep(const Kernel<T>& kernel, const Matrix& a) {
  Harness<T> harness(kernel);
  const auto b = random_values<T>(kernel.unknowns(), 2), x = random_values<T>(kernel.unknowns(), 3);
  harness.load(b, 2);
  kernel.divide_by_diagonal(harness.vector(2), harness.vector(0));
  harness.load(x, 1);
  const T squared = kernel.jacobi_sweep(harness.vector(0), harness.vector(1), harness.vector(2), nullptr);
  const Vector residual = as_vector(b) - a * as_vector(x);
  const Vector next = as_vector(x) + residual.cwiseQuotient(a.diagonal());
  const double scale = 30 * kTolerance<T>;
  EXPECT_LT((as_vector(harness.store(2)) - next).norm(), scale * (1 + next.norm()));
  EXPECT_NEAR(static_cast<double>(squared), residual.squaredNorm(), scale * a.squaredNorm());
  harness.expect_clean_padding(0);
  harness.expect_clean_padding(2);
}

/// `expected`: what the factors must give for the right-hand side of as many random values.
template <class T>
void expect_solution(const Kernel<T>& kernel, const std::function<Vector(const Vector&)>& expected) {
  const auto factors = kernel.factorise();
  Harness<T> harness(kernel);
  for (const unsigned seed : {21u, 22u}) {
    const auto r = random_values<T>(kernel.unknowns(), seed);
    harness.load(r, 0);
    ASSERT_TRUE(factors->solve(harness.vector(0), harness.vector(1)));
    const Vector x = expected(as_vector(r));
    EXPECT_LT((as_vector(harness.store(1)) - x).norm(), 1e3 * kTolerance<T> * (1 + x.norm()));
    harness.expect_clean_padding(1);
  }
}

template <class T>
void expect_adjoint(const Kernel<T>& a, const Kernel<T>& transpose) {
  Harness<T> forward(a), backward(transpose);
  const auto x = random_values<T>(a.unknowns(), 7), y = random_values<T>(a.unknowns(), 8);
  const Vector ax = as_vector(forward.apply(x)), aty = as_vector(backward.apply(y));
  const double scale = ax.norm() * as_vector(y).norm() + aty.norm() * as_vector(x).norm();
  EXPECT_NEAR(ax.dot(as_vector(y)), aty.dot(as_vector(x)), 4 * kTolerance<T> * scale);
}

}  // namespace prdp_test
