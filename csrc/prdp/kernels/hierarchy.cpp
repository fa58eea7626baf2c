#include "prdp/kernels/hierarchy.h"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <limits>

#include "prdp/kernels/assembly.h"
#include "prdp/kernels/coarsening.h"
#include "prdp/kernels/galerkin.h"

namespace prdp::kernels {

namespace {

/// Σ_k |a_k| / |a_0|, the largest of all points; infinite where a diagonal is zero.
template <class T>
double gershgorin_bound(const StencilFields<T>& a) {
  const T* diagonal = a.coefficients[StencilFields<T>::kCentre];
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

/// The axes along which to coarsen (coarsening.h), by a sample of the points, an odd number apart.
template <class T>
Axes choose_axes(const StencilFields<T>& a) {
  const int64_t n = a.points(), step = std::max<int64_t>(n / 4096, 1) | 1;
  Couplings couplings;
  for (int k = 0; k < 27; ++k) {
    if (!a.coefficients[k]) continue;
    double sum = 0;
    for (int64_t i = 0; i < n; i += step) sum += std::abs(static_cast<double>(a.coefficients[k][i]));
    for (int d = 0; d < 3; ++d)
      if (StencilFields<T>::offset(k).along[d] != 0) couplings.along[d] += sum;
  }
  const auto& [nz, ny, nx] = a.grid.shape;
  if (!may_need_one_point(a.grid.shape, 3)) return axes_to_coarsen(a.grid.shape, 3, couplings);
  for (int64_t i = 0; i < n; i += step) {
    const int64_t at[3] = {i / (ny * nx), i / nx % ny, i % nx};
    double net[3][2] = {}, row = 0;
    for (int k = 0; k < 27; ++k) {
      if (!a.coefficients[k]) continue;
      const double value = static_cast<double>(a.coefficients[k][i]);
      bool inside = true;
      for (int d = 0; d < 3; ++d) {
        const auto o = StencilFields<T>::offset(k).along[d];
        if (o != 0) net[d][o > 0] += value;
        inside = inside && neighbour(at[d], o, a.grid.shape[d], a.grid.periodic[d]) >= 0;
      }
      if (inside) row += value;
    }
    for (int d = 0; d < 3; ++d) couplings.net[d] += std::abs(net[d][0]) + std::abs(net[d][1]);
    couplings.rows += std::abs(row);
  }
  return axes_to_coarsen(a.grid.shape, 3, couplings);
}

template <class T>
std::shared_ptr<const PackedStencil<T>> pack(const StencilFields<T>& a, bool transposed) {
  std::vector<Offset> offsets;
  std::vector<const T*> fields;
  for (int k = 0; k < 27; ++k)
    if (a.coefficients[k]) {
      fields.push_back(a.coefficients[k]);
      offsets.push_back(StencilFields<T>::offset(transposed ? 26 - k : k));  // 26 - k: the opposite one
    }
  const auto pattern = std::make_shared<StencilSparsity>(a.grid, offsets);
  return std::make_shared<PackedStencil<T>>(assemble_rows(pattern, fields, T(1), transposed));
}

template <class T>
bool all_finite(const StencilFields<T>& a) {
  return std::all_of(a.memory.begin(), a.memory.end(), [](const auto& field) {
    return std::isfinite(largest_magnitude(field.data(), static_cast<int64_t>(field.size())));
  });
}

using Eigen::MatrixXd;

/// Of at most 64 rows: a bit for each entry of one.
int count_parts(const MatrixXd& m) {
  const int n = static_cast<int>(m.rows());
  std::vector<uint64_t> of_row(n), of_column(n);
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < n; ++j) {
      const uint64_t is_entry = m(i, j) != 0.0;
      of_row[i] |= is_entry << j;
      of_column[j] |= is_entry << i;
    }
  return kernels::count_parts(n, of_row.data(), of_column.data());
}

/// The inverse without what is tiny.
struct PseudoInverse {
  MatrixXd matrix;
  bool is_whole;  // nothing was left out but the null space

  /// `nullity`: how many null vectors A is said to have. As many of the least singular values are left out, even where
  /// rounding has made them larger than `tiny`: their inverse would be rounding. But a part of the grid that nothing
  /// couples to the rest may be gone on so coarse a grid, and its null vector with it: then only those below 1e-3 are.
  PseudoInverse(const MatrixXd& m, int64_t nullity, double tiny) {
    const Eigen::JacobiSVD<MatrixXd> svd(m, Eigen::ComputeFullU | Eigen::ComputeFullV);
    const auto& singular = svd.singularValues();
    const bool all_are_there = count_parts(m) >= nullity;
    Eigen::VectorXd inverse = Eigen::VectorXd::Zero(m.rows());
    is_whole = true;
    for (int64_t i = 0; i < m.rows(); ++i) {
      const double size = singular[i] / singular[0];
      if (i >= m.rows() - nullity && (all_are_there || size < 1e-3)) continue;
      if (size > tiny) inverse[i] = 1.0 / singular[i];
      else is_whole = false;
    }
    matrix = svd.matrixV() * inverse.asDiagonal() * svd.matrixU().transpose();
  }
};

MatrixXd invert(const MatrixXd& m, int64_t nullity, double tiny) {
  if (nullity > 0) {
    PseudoInverse found(m, nullity, tiny);
    if (found.is_whole) return std::move(found.matrix);
  } else {
    const Eigen::PartialPivLU<MatrixXd> lu(m);
    const auto pivots = lu.matrixLU().diagonal().cwiseAbs();
    if (pivots.minCoeff() > tiny * pivots.maxCoeff()) return lu.inverse();
  }
  // What is tiny may only be so beside a larger diagonal: it is brought to the order of one.
  const Eigen::VectorXd d = m.diagonal().unaryExpr(
      [](double a) { return a == 0.0 ? 1.0 : std::exp2(-std::round(std::log2(std::abs(a)) / 2)); });
  const MatrixXd scaled = d.asDiagonal() * m * d.asDiagonal();
  if (nullity > 0) return d.asDiagonal() * PseudoInverse(scaled, nullity, tiny).matrix * d.asDiagonal();
  Eigen::CompleteOrthogonalDecomposition<MatrixXd> decomposition;
  decomposition.setThreshold(tiny);
  return d.asDiagonal() * decomposition.compute(scaled).pseudoInverse() * d.asDiagonal();
}

}  // namespace

template <class T>
std::unique_ptr<const Hierarchy<T>> Hierarchy<T>::make(StencilFields<T> finest, int64_t nullity) {
  std::unique_ptr<Hierarchy> h(new Hierarchy);
  h->symmetric_ = is_symmetric(finest);
  StencilFields<T> a = std::move(finest);
  const auto keep_fields = [&] {  // of all grids but the finest, like packed_
    if (h->levels_.size() > 1 && !h->symmetric_) h->fields_.push_back(std::move(a));
  };
  for (;;) {
    const double radius = gershgorin_bound(a);
    if (!std::isfinite(radius) || !all_finite(a)) return nullptr;
    h->levels_.push_back({a.grid, radius, {}});
    if (h->levels_.size() > 1) h->packed_.push_back(pack(a, false));
    const auto axes = choose_axes(a);
    StencilFields<T> coarse(a.grid);
    for (const int axis : axes) {
      const auto& fine = axis == axes.front() ? a : coarse;
      const auto weights = make_transfer(fine, axis, h->symmetric_);
      h->levels_.back().transfers.emplace_back(fine.grid, axis, weights, h->symmetric_);
      coarse = galerkin_product(fine, axis, weights);
    }
    if (axes.empty()) break;
    keep_fields();
    a = std::move(coarse);
  }
  if (!h->invert_coarsest(a, nullity)) return nullptr;
  keep_fields();
  h->transposed_.resize(h->packed_.size());
  return h;
}

template <class T>
bool Hierarchy<T>::invert_coarsest(const StencilFields<T>& a, int64_t nullity) {
  const auto rows = pack(a, false);
  const int64_t n = a.points();
  MatrixXd m = MatrixXd::Zero(n, n);
  rows->for_each_entry([&](int64_t i, int64_t j, double value) { m(i, j) += value; });
  const double tiny = 10.0 * static_cast<double>(n) * static_cast<double>(std::numeric_limits<T>::epsilon());
  const MatrixXd inverse = invert(m, nullity, tiny);
  coarsest_inverse_.resize(n * n);
  for (int64_t i = 0; i < n; ++i)
    for (int64_t j = 0; j < n; ++j) coarsest_inverse_[i * n + j] = static_cast<T>(inverse(i, j));
  return std::isfinite(largest_magnitude(coarsest_inverse_.data(), n * n));
}

template <class T>
std::shared_ptr<const PackedStencil<T>> Hierarchy<T>::packed(size_t l, bool transposed) const {
  if (!transposed || symmetric_) return packed_[l - 1];
  const std::lock_guard lock(mutex_);
  auto& rows = transposed_[l - 1];
  if (!rows) rows = pack(fields_[l - 1], true);
  return rows;
}

template <class T>
int64_t Hierarchy<T>::bytes() const {
  int64_t sum = static_cast<int64_t>(coarsest_inverse_.size() * sizeof(T));
  for (const auto& level : levels_)
    for (const auto& transfer : level.transfers) sum += transfer.bytes();
  for (const auto& rows : packed_)
    sum += (symmetric_ ? 1 : 3) * rows->bytes();  // with their fields and the transposed rows
  return sum;
}

template class Hierarchy<float>;
template class Hierarchy<double>;

}  // namespace prdp::kernels
