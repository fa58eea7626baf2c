#pragma once
#include <ATen/ATen.h>
#include <ATen/CPUGeneratorImpl.h>

#include <vector>

namespace prdp_test {

/// Random (batch, 1, *shape) in float64, the same at every call with the same arguments.
inline at::Tensor random_field(std::vector<int64_t> shape, int64_t batch) {
  shape.insert(shape.begin(), {batch, 1});
  auto generator = at::detail::createCPUGenerator(7);
  return at::randn(shape, generator, at::kDouble);
}

/// The Dirichlet Laplacian as a matrix, by Kronecker sums: independent of the library's stencils.
inline at::Tensor dense_laplacian(const std::vector<int64_t>& shape) {
  auto sum = at::zeros({1, 1}, at::kDouble);
  for (const int64_t n : shape) {
    const auto second = (-2.0 * at::eye(n, at::kDouble) + at::diag(at::ones({n - 1}, at::kDouble), 1) +
                         at::diag(at::ones({n - 1}, at::kDouble), -1)) *
                        static_cast<double>((n + 1) * (n + 1));
    sum = at::kron(sum, at::eye(n, at::kDouble)) + at::kron(at::eye(sum.size(0), at::kDouble), second);
  }
  return sum;
}

}  // namespace prdp_test
