#include <gtest/gtest.h>
#include <torch/torch.h>

#include "helpers.h"
#include "prdp/operators/kinds.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/prdp.h"

namespace {

/// The largest sum of magnitudes in a row, column by column of the product with the identity.
double largest_row_sum(const prdp::Operator& a, const std::vector<int64_t>& of_sample) {
  auto shape = of_sample;
  const int64_t n = c10::multiply_integers(of_sample);
  shape.insert(shape.begin(), n);
  return a.apply(at::eye(n, at::kDouble).view(shape)).abs().sum(0).max().item<double>();
}

TEST(Norm, OfATransposeIsTheLargestSumInItsRows) {
  const auto matrix = prdp_test::random_field({7, 7}, 1).squeeze(1);
  const auto csr = (matrix[0] * (matrix[0] > 0)).to_sparse_csr();
  const auto coefficients = prdp_test::random_field({5, 4, 6}, 1).squeeze(1);
  const std::vector<std::vector<int64_t>> offsets{{0, 0}, {0, -1}, {0, 1}, {-1, 0}, {2, 1}};
  const auto winds = prdp_test::random_field({3, 5, 4}, 1).squeeze(1);
  const auto nu = at::scalar_tensor(0.3, at::kDouble);
  const std::vector<std::pair<prdp::OperatorSpec, std::vector<int64_t>>> operators{
      {prdp::matrix(matrix[0]), {7}},
      {prdp::csr_matrix(csr.crow_indices(), csr.col_indices(), csr.values()), {7}},
      {prdp::stencil(coefficients, offsets, {prdp::Boundary::kPeriodic, prdp::Boundary::kDirichlet}), {1, 4, 6}},
      {{"burgers", {5, 4}, {0.1}, {winds.narrow(1, 0, 2), nu}}, {2, 5, 4}},
      {{"navier_stokes", {5, 4}, {0.1}, {winds, nu}}, {3, 5, 4}},
      {prdp::diffusion(coefficients.narrow(1, 0, 1).squeeze(1).exp(), 2.0), {1, 4, 6}},
  };
  for (auto [spec, shape] : operators)
    for (const bool transposed : {false, true}) {
      spec.transposed = transposed;
      const auto a = prdp::make_operator(spec);
      EXPECT_NEAR(a->norm().max().item<double>(), largest_row_sum(*a, shape), 1e-12 * largest_row_sum(*a, shape))
          << spec.kind << (transposed ? ", transposed" : "");
    }
}

}  // namespace
