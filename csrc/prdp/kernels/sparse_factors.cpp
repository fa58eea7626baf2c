#include "prdp/kernels/sparse_factors.h"

#include <Eigen/SparseCholesky>
#include <Eigen/SparseLU>
#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>

#include "prdp/kernels/band_factors.h"
#include "prdp/kernels/cholesky_solve.h"
#include "prdp/kernels/equilibration.h"
#include "prdp/kernels/flush_subnormals.h"
#include "prdp/threads/thread_to_leave.h"

namespace prdp::kernels {

namespace {

using Matrix = SparseFactors::Matrix;

/// The least share of its column or row that a pivot of n unknowns is not rounding.
double rounding_of(Eigen::Index n) { return std::numeric_limits<double>::epsilon() * static_cast<double>(n); }

/// LU that tells its pivots.
class PivotedLU : public Eigen::SparseLU<Matrix> {
 public:
  /// Whether the pivot of every column is larger than its share of the sum of that column's magnitudes.
  bool pivots_exceed(double share, const Eigen::VectorXd& sums) const {
    Eigen::VectorXd pivot = Eigen::VectorXd::Zero(this->cols());
    for (Eigen::Index j = 0; j < this->cols(); ++j)
      for (SCMatrix::InnerIterator it(this->m_Lstore, j); it; ++it)
        if (it.index() == j) {
          pivot[j] = std::abs(it.value());
          break;
        }
    const auto& place = this->colsPermutation().indices();
    for (Eigen::Index j = 0; j < this->cols(); ++j)
      if (!(pivot[place[j]] > share * sums[j])) return false;
    return true;
  }
};

/// Whether every pivot is larger than this share of what it was before anything was taken off, Σ l² of its row.
bool pivots_exceed(double share, const Eigen::SimplicialLLT<Matrix>& cholesky) {
  const auto& l = cholesky.matrixL().nestedExpression();
  Eigen::VectorXd pivot(l.rows()), whole = Eigen::VectorXd::Zero(l.rows());
  for (Eigen::Index j = 0; j < l.cols(); ++j) {  // the diagonal comes first in each column
    pivot[j] = std::pow(l.valuePtr()[l.outerIndexPtr()[j]], 2);
    for (auto k = l.outerIndexPtr()[j]; k < l.outerIndexPtr()[j + 1]; ++k)
      whole[l.innerIndexPtr()[k]] += std::pow(l.valuePtr()[k], 2);
  }
  return (pivot.array() > share * whole.array()).all();
}

/// Whether the pattern is symmetric, and the values are up to the rounding of sums that they are assembled from: less
/// than what Cholesky's method loses of √(a_ii a_jj).
bool is_symmetric(const Matrix& m) {
  const Matrix t = m.transpose();
  const bool pattern = std::equal(m.outerIndexPtr(), m.outerIndexPtr() + m.outerSize() + 1, t.outerIndexPtr()) &&
                       std::equal(m.innerIndexPtr(), m.innerIndexPtr() + m.nonZeros(), t.innerIndexPtr());
  if (!pattern) return false;
  if (std::equal(m.valuePtr(), m.valuePtr() + m.nonZeros(), t.valuePtr())) return true;
  const Eigen::VectorXd root = Eigen::VectorXd(m.diagonal()).cwiseAbs().cwiseSqrt();
  constexpr double roundings = 8.0 * std::numeric_limits<double>::epsilon();
  for (Eigen::Index j = 0; j < m.outerSize(); ++j)
    for (auto k = m.outerIndexPtr()[j]; k < m.outerIndexPtr()[j + 1]; ++k)
      if (!(std::abs(m.valuePtr()[k] - t.valuePtr()[k]) <= roundings * root[j] * root[m.innerIndexPtr()[k]]))
        return false;
  return true;
}

/// Eigen's ordering and factorisation may not return if a row or a column is empty.
bool has_empty_line(const Matrix& m) {
  std::vector<char> row(m.rows()), column(m.cols());
  for (Eigen::Index j = 0; j < m.outerSize(); ++j)
    for (Matrix::InnerIterator it(m, j); it; ++it)
      if (it.value() != 0.0) row[it.row()] = column[it.col()] = true;
  const auto empty = [](char entries) { return !entries; };
  return std::any_of(row.begin(), row.end(), empty) || std::any_of(column.begin(), column.end(), empty);
}

/// For each of n indices its place among those that are not left out, or -1.
Eigen::VectorXi places(int64_t n, const std::vector<int64_t>& left_out) {
  Eigen::VectorXi place = Eigen::VectorXi::Zero(n);
  for (const int64_t i : left_out) place[i] = -1;
  for (int64_t i = 0, next = 0; i < n; ++i)
    if (place[i] == 0) place[i] = static_cast<int>(next++);
  return place;
}

}  // namespace

std::vector<int64_t> pivots(std::vector<std::vector<double>> vectors) {
  std::vector<int64_t> found;
  for (size_t k = 0; k < vectors.size(); ++k) {
    const auto& v = vectors[k];
    const auto largest =
        std::max_element(v.begin(), v.end(), [](double a, double b) { return std::abs(a) < std::abs(b); });
    const auto at = largest - v.begin();
    found.push_back(at);
    for (size_t j = k + 1; j < vectors.size(); ++j) {
      const double share = vectors[j][at] / v[at];
      if (share == 0.0) continue;
      for (size_t i = 0; i < v.size(); ++i) vectors[j][i] -= share * v[i];
      vectors[j][at] = 0.0;
    }
  }
  return found;
}

struct SparseFactors::Factorised {
  double sign = 1.0;
  std::optional<Eigen::SimplicialLLT<Matrix>> cholesky;
  mutable PivotedLU lu;
  std::optional<Equilibration> scales;  // of what lu belongs to
  bool is_regular = false;

  explicit Factorised(const Matrix& m) {
    if (m.rows() > 0 && has_empty_line(m)) return;
    const FlushSubnormals flush;
    if (is_symmetric(m)) {
      if (m.rows() > 0 && m.coeff(0, 0) < 0.0) sign = -1.0;
      cholesky.emplace(Matrix(sign * m));
      if (cholesky->info() == Eigen::Success) {
        is_regular = pivots_exceed(rounding_of(m.rows()), *cholesky);
        return;
      }
      cholesky.reset();
    }
    factor(m);
    if (is_regular) return;
    // Its rows and columns may only differ much in size.
    auto found = equilibrate(m.rows(), [&](const auto& body) {
      for (Eigen::Index j = 0; j < m.outerSize(); ++j)
        for (Matrix::InnerIterator it(m, j); it; ++it) body(it.row(), it.col(), it.value());
    });
    if (!found.matters()) return;
    factor(found.rows.asDiagonal() * m * found.columns.asDiagonal());
    scales = std::move(found);
  }

 private:
  void factor(const Matrix& m) {
    Eigen::VectorXd sums = Eigen::VectorXd::Zero(m.cols());
    for (Eigen::Index j = 0; j < m.outerSize(); ++j)
      for (Matrix::InnerIterator it(m, j); it; ++it) sums[j] += std::abs(it.value());
    lu.compute(m);
    is_regular = lu.info() == Eigen::Success && lu.pivots_exceed(rounding_of(m.rows()), sums);
  }
};

SparseFactors::SparseFactors(const Triplets& entries, int64_t n, const Pins& pins)
    : kept_unknowns_(places(n, pins.unknowns)), kept_equations_(places(n, pins.equations)) {
  const auto size = n - static_cast<int64_t>(pins.unknowns.size());
  Triplets kept;
  for (const auto& e : entries)  // zeros, such as those between the columns of a field, would fill in
    if (e.value() != 0.0 && kept_equations_[e.row()] >= 0 && kept_unknowns_[e.col()] >= 0)
      kept.emplace_back(kept_equations_[e.row()], kept_unknowns_[e.col()], e.value());
  band_ = BandFactors::make(kept, size, rounding_of(size));
  if (band_) return;
  auto m = std::make_shared<Matrix>(size, size);
  m->setFromTriplets(kept.begin(), kept.end());
  factorised_ = interruption::in_a_thread_to_leave(entries.size() > 100'000,
                                                   [m] { return std::make_shared<const Factorised>(*m); });
}

SparseFactors::~SparseFactors() = default;

bool SparseFactors::is_regular() const { return band_ || factorised_->is_regular; }

bool SparseFactors::gains_by_several() const { return band_ || factorised_->cholesky; }

void SparseFactors::solve(Eigen::Ref<Eigen::MatrixXd> x, bool transposed) const {
  const FlushSubnormals flush;
  const auto& to_take = transposed ? kept_unknowns_ : kept_equations_;
  const auto& to_give = transposed ? kept_equations_ : kept_unknowns_;
  if (gains_by_several()) {
    solve_side_by_side<8>(x, to_take, to_give, transposed);
    return;
  }
  const auto& scales = factorised_->scales;
  const auto n = static_cast<int64_t>(x.rows());
  Eigen::VectorXd rhs(to_take.size() == 0 ? 0 : to_take.maxCoeff() + 1), found;
  for (auto column : x.colwise()) {
    for (int64_t i = 0; i < n; ++i)
      if (to_take[i] >= 0) rhs[to_take[i]] = column[i];
    if (scales) rhs.array() *= (transposed ? scales->columns : scales->rows).array();
    if (transposed) found = factorised_->lu.transpose().solve(rhs);
    else found = factorised_->lu.solve(rhs);
    if (scales) found.array() *= (transposed ? scales->rows : scales->columns).array();
    for (int64_t i = 0; i < n; ++i) column[i] = to_give[i] >= 0 ? found[to_give[i]] : 0.0;
  }
}

template <int Count>
void SparseFactors::solve_side_by_side(Eigen::Ref<Eigen::MatrixXd> x, const Eigen::VectorXi& to_take,
                                       const Eigen::VectorXi& to_give, bool transposed) const {
  Eigen::Index column = 0;
  for (; column + Count <= x.cols(); column += Count)
    solve_block<Count>(x.middleCols<Count>(column), to_take, to_give, transposed);
  if constexpr (Count > 1) solve_side_by_side<Count / 2>(x.rightCols(x.cols() - column), to_take, to_give, transposed);
}

template <int Count>
void SparseFactors::solve_block(Block<Count> x, const Eigen::VectorXi& to_take, const Eigen::VectorXi& to_give,
                                bool transposed) const {
  const auto* const cholesky = band_ ? nullptr : &*factorised_->cholesky;
  const double sign = band_ ? 1.0 : factorised_->sign;
  const auto place = [&](int64_t i) { return band_ ? band_->place(i) : cholesky->permutationP().indices()[i]; };
  std::vector<double> side_by_side((band_ ? band_->length() : cholesky->rows()) * Count);
  double* const memory = side_by_side.data();
  for (int64_t i = 0; i < x.rows(); ++i) {
    if (to_take[i] < 0) continue;
    double* const to = memory + place(to_take[i]) * Count;
    for (int c = 0; c < Count; ++c) to[c] = x(i, c);
  }
  if (band_) band_->solve<Count>(memory, transposed);
  else solve_cholesky<Count>(cholesky->matrixL().nestedExpression(), memory);
  for (int64_t i = 0; i < x.rows(); ++i) {
    const double* const from = to_give[i] >= 0 ? memory + place(to_give[i]) * Count : nullptr;
    for (int c = 0; c < Count; ++c) x(i, c) = from ? sign * from[c] : 0.0;
  }
}

int64_t SparseFactors::bytes() const {
  if (band_) return band_->bytes() + kept_unknowns_.size() * 8;
  const int64_t stored = factorised_->cholesky ? factorised_->cholesky->matrixL().nestedExpression().nonZeros()
                         : is_regular()        ? int64_t{factorised_->lu.nnzL()} + factorised_->lu.nnzU()
                                               : 0;
  constexpr int64_t beside = 64 << 10;  // what Eigen keeps of its workspace, about, as measured from 6² to 24²
  return stored * static_cast<int64_t>(sizeof(double) + sizeof(int)) + kept_unknowns_.size() * 8 + beside;
}

}  // namespace prdp::kernels
