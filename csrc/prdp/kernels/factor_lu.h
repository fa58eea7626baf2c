#pragma once
#include <Eigen/LU>
#include <cstdint>

namespace prdp::kernels {

namespace {

/// See Loops<T>::factor_lu.
void factor_lu(double* a, int64_t stride, int64_t n, int64_t* rows) {
  Eigen::Map<Eigen::MatrixXd, 0, Eigen::OuterStride<>> matrix(a, n, n, Eigen::OuterStride<>(stride));
  const Eigen::PartialPivLU<Eigen::Ref<Eigen::MatrixXd>> lu(matrix);
  const auto& place = lu.permutationP().indices();
  for (int64_t i = 0; i < n; ++i) rows[place[i]] = i;
}

}  // namespace

}  // namespace prdp::kernels
