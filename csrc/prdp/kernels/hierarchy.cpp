#include "prdp/kernels/hierarchy.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <limits>

#include "prdp/kernels/given_stencil.h"

namespace prdp::kernels {

namespace {

/// Σ_k |a_k| / |a_0|, the largest of all points; infinite where a diagonal is zero.
template <class T>
double radius_of(const RawStencil<T>& a) {
  const T* diagonal = a.coefficients[RawStencil<T>::kCentre];
  const T largest = largest_of_blocks<T>(a.points(), [&](int64_t begin, int64_t end) {
    std::vector<T> ratios(end - begin, T(0));
    for (const T* field : a.coefficients)
      if (field)
        for (int64_t i = begin; i < end; ++i) ratios[i - begin] += std::abs(field[i]);
    for (int64_t i = begin; i < end; ++i) ratios[i - begin] /= std::abs(diagonal[i]);
    return loops<T>().largest_magnitude(ratios.data(), end - begin);
  });
  return std::isfinite(largest) ? static_cast<double>(largest) : std::numeric_limits<double>::infinity();
}

/// By a sample of the points.
template <class T>
std::vector<int> axes_to_coarsen(const RawStencil<T>& a) {
  const int64_t n = a.points(), step = std::max<int64_t>(n / 4096, 1) | 1;
  double coupling[3] = {};
  for (int k = 0; k < 27; ++k) {
    if (!a.coefficients[k]) continue;
    double sum = 0;
    for (int64_t i = 0; i < n; i += step) sum += std::abs(static_cast<double>(a.coefficients[k][i]));
    for (int d = 0; d < 3; ++d)
      if (RawStencil<T>::offset(k).along[d] != 0) coupling[d] += sum;
  }
  return kernels::axes_to_coarsen(a.grid.shape, coupling);
}

template <class T>
std::shared_ptr<const StencilRows<T>> rows_of(const RawStencil<T>& a, bool transposed) {
  std::vector<Offset> offsets;
  std::vector<const T*> fields;
  for (int k = 0; k < 27; ++k)
    if (a.coefficients[k]) {
      fields.push_back(a.coefficients[k]);
      offsets.push_back(RawStencil<T>::offset(transposed ? 26 - k : k));
    }
  const auto pattern = std::make_shared<StencilPattern>(a.grid, offsets);
  return std::make_shared<StencilRows<T>>(assemble_rows(pattern, fields, T(1), transposed));
}

template <class T>
bool all_finite(const RawStencil<T>& a) {
  return std::all_of(a.memory.begin(), a.memory.end(), [](const auto& field) {
    return std::isfinite(largest_magnitude(field.data(), static_cast<int64_t>(field.size())));
  });
}

}  // namespace

template <class T>
std::unique_ptr<const Hierarchy<T>> Hierarchy<T>::make(RawStencil<T> finest, int64_t nullity) {
  std::unique_ptr<Hierarchy> h(new Hierarchy);
  h->symmetric_ = is_symmetric(finest);
  RawStencil<T> a = std::move(finest);
  for (;;) {
    const double radius = radius_of(a);
    if (!std::isfinite(radius) || !all_finite(a)) return nullptr;
    h->levels_.push_back({a.grid, radius, {}});
    if (h->levels_.size() > 1) h->rows_.push_back(rows_of(a, false));
    const auto axes = axes_to_coarsen(a);
    RawStencil<T> coarse(a.grid);
    for (const int axis : axes) {
      const auto& fine = axis == axes.front() ? a : coarse;
      const auto weights = make_transfer(fine, axis, h->symmetric_);
      h->levels_.back().transfers.emplace_back(fine.grid, axis, weights, h->symmetric_);
      coarse = collapse(fine, axis, weights);
    }
    if (axes.empty()) break;
    if (h->levels_.size() > 1 && !h->symmetric_) h->raw_.push_back(std::move(a));
    a = std::move(coarse);
  }
  if (!h->invert_coarsest(a, nullity)) return nullptr;
  if (h->levels_.size() > 1 && !h->symmetric_) h->raw_.push_back(std::move(a));
  h->transposed_.resize(h->rows_.size());
  return h;
}

template <class T>
bool Hierarchy<T>::invert_coarsest(const RawStencil<T>& a, int64_t nullity) {
  const auto rows = rows_of(a, false);
  const int64_t n = a.points();
  Eigen::MatrixXd m = Eigen::MatrixXd::Zero(n, n);
  rows->for_each_entry([&](int64_t i, int64_t j, T value) { m(i, j) += static_cast<double>(value); });
  const double tiny = 10.0 * static_cast<double>(n) * static_cast<double>(std::numeric_limits<T>::epsilon());
  const Eigen::PartialPivLU<Eigen::MatrixXd> lu(m);
  const auto pivots = lu.matrixLU().diagonal().cwiseAbs();
  Eigen::MatrixXd inverse;
  if (nullity > 0) {
    // Rounding of the coefficients may have made the matrix regular; its inverse would be rounding all the same.
    const Eigen::JacobiSVD<Eigen::MatrixXd> svd(m, Eigen::ComputeFullU | Eigen::ComputeFullV);
    Eigen::VectorXd values = Eigen::VectorXd::Zero(n);
    for (int64_t i = 0; i < n - nullity; ++i)
      if (svd.singularValues()[i] > tiny * svd.singularValues()[0]) values[i] = 1.0 / svd.singularValues()[i];
    inverse = svd.matrixV() * values.asDiagonal() * svd.matrixU().transpose();
  } else if (pivots.minCoeff() > tiny * pivots.maxCoeff()) {
    inverse = lu.inverse();
  } else {
    Eigen::CompleteOrthogonalDecomposition<Eigen::MatrixXd> decomposition;
    decomposition.setThreshold(tiny);
    inverse = decomposition.compute(m).pseudoInverse();
  }
  coarsest_inverse_.resize(n * n);
  for (int64_t i = 0; i < n; ++i)
    for (int64_t j = 0; j < n; ++j) coarsest_inverse_[i * n + j] = static_cast<T>(inverse(i, j));
  return std::isfinite(largest_magnitude(coarsest_inverse_.data(), n * n));
}

template <class T>
std::shared_ptr<const StencilRows<T>> Hierarchy<T>::rows(size_t l, bool transposed) const {
  if (!transposed || symmetric_) return rows_[l - 1];
  const std::lock_guard lock(mutex_);
  auto& rows = transposed_[l - 1];
  if (!rows) rows = rows_of(raw_[l - 1], true);
  return rows;
}

template <class T>
int64_t Hierarchy<T>::bytes() const {
  int64_t sum = static_cast<int64_t>(coarsest_inverse_.size() * sizeof(T));
  for (const auto& level : levels_)
    for (const auto& transfer : level.transfers) sum += transfer.bytes();
  for (const auto& rows : rows_) sum += (symmetric_ ? 1 : 3) * rows->bytes();  // with the raw and the transposed ones
  return sum;
}

template class Hierarchy<float>;
template class Hierarchy<double>;

}  // namespace prdp::kernels
