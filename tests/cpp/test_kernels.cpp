#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "prdp/kernels/laplacian.h"
#include "prdp/kernels/vector.h"

namespace {

using namespace prdp::kernels;

TEST(Vector, DotAddsEveryLength) {
  for (int64_t n = 0; n <= 200; ++n) {
    std::vector<double> a(n), b(n, 2.0);
    for (int64_t i = 0; i < n; ++i) a[i] = static_cast<double>(i + 1);
    EXPECT_EQ(loops<double>().dot(a.data(), b.data(), n), static_cast<double>(n * (n + 1)));
  }
}

template <class T>
void expect_sums_over_vectors(double tolerance) {
  for (const int64_t n : {0, 16, 32, 48, 64, 272})
    for (int64_t count = 1; count <= 19; ++count) {
      SCOPED_TRACE(testing::Message() << count << " vectors of " << n);
      const auto value = [](int64_t j, int64_t i) { return static_cast<T>(std::sin(1.7 * j + 0.3 * i * i)); };
      std::vector<std::vector<T>> vectors(count + 1, std::vector<T>(n));
      std::vector<const T*> v;
      std::vector<T> alpha, h(count + 1, T(7));
      for (int64_t j = 0; j <= count; ++j) {
        for (int64_t i = 0; i < n; ++i) vectors[j][i] = value(j, i);
        v.push_back(vectors[j].data());
        alpha.push_back(value(j, 99));
      }
      auto w = vectors[count];
      const T factor = count % 2 ? T(1) : T(0.75);
      loops<T>().multi_dot(v.data(), count, factor, w.data(), h.data(), n);
      loops<T>().multi_axpy(T(-1), alpha.data(), v.data(), count, factor, w.data(), n);
      std::vector<double> products(count), rest(n);
      for (int64_t i = 0; i < n; ++i) {
        const double before = factor * vectors[count][i];
        rest[i] = before;
        for (int64_t j = 0; j < count; ++j) {
          products[j] += before * vectors[j][i];
          rest[i] -= static_cast<double>(alpha[j]) * vectors[j][i];
        }
        EXPECT_NEAR(w[i], rest[i], tolerance);
      }
      for (int64_t j = 0; j < count; ++j) EXPECT_NEAR(h[j], products[j], tolerance);
      EXPECT_EQ(h[count], T(7));
    }
}
TEST(Vector, SumsOverManyVectorsEqualSumsOverEach) {
  expect_sums_over_vectors<float>(1e-4);
  expect_sums_over_vectors<double>(1e-12);
}

TEST(Vector, LargestMagnitudeSeesNaNAndInf) {
  const float nan = std::nanf(""), inf = std::numeric_limits<float>::infinity();
  const float finite[] = {-3.0f, 2.0f, -0.0f}, with_nan[] = {1.0f, -nan, 9.0f}, with_inf[] = {1.0f, -inf};
  EXPECT_EQ(largest_magnitude(finite, 3), 3.0f);
  EXPECT_TRUE(std::isnan(largest_magnitude(with_nan, 3)));
  EXPECT_TRUE(std::isinf(largest_magnitude(with_inf, 2)));
  EXPECT_EQ(largest_magnitude(finite, 0), 0.0f);
}

template <class T>
void expect_scale_in_range() {
  for (T x = std::numeric_limits<T>::min(); x < std::numeric_limits<T>::max() / 4; x *= T(3.7)) {
    const T scale = power_of_two_scale(x);
    int exponent;
    EXPECT_EQ(std::frexp(scale, &exponent), T(0.5)) << "a power of two";
    EXPECT_TRUE(std::isfinite(T(1) / scale));
    EXPECT_GE(x * scale, T(0.9));
    EXPECT_LT(x * scale, T(4.1));
  }
}
TEST(Vector, ScaleIsAPowerOfTwoFromTheSmallestToTheLargestNumbers) {
  expect_scale_in_range<float>();
  expect_scale_in_range<double>();
}

TEST(Laplacian, PaddingStaysZeroInEveryProduct) {
  const LaplacianParameters p{3, {3, 4, 5}, 7.0, {-1.0, -2.0, -3.0}};
  const Laplacian<float, 3> kernel(p);
  auto& workspace = Workspace<float>::local();
  const int64_t halo = kernel.layout().halo;
  workspace.prepare(3, kernel.length(), halo);
  const std::vector<float> ones(kernel.unknowns(), 1.0f);
  kernel.layout().load(ones.data(), 1.0f, workspace.vector(0));
  kernel.apply(workspace.vector(0), workspace.vector(1));
  kernel.jacobi_sweep(workspace.vector(0), workspace.vector(1), workspace.vector(2), nullptr);
  std::vector<float> values(kernel.unknowns());
  for (const int64_t v : {1, 2}) {
    double inside = 0, all = 0;
    kernel.layout().store(workspace.vector(v), 1.0f, values.data());
    for (const float x : values) inside += std::abs(x);
    for (int64_t i = -halo; i < kernel.length() + halo; ++i) all += std::abs(workspace.vector(v)[i]);
    EXPECT_EQ(inside, all);
  }
}

}  // namespace
