#include <algorithm>
#include <cmath>
#include <limits>

#include "prdp/kernels/fast_diagonalisation.h"

/// Which stencils are sums of operators along the axes.
namespace prdp::kernels {

namespace {

/// Coefficients as StencilSparsity::nearest_neighbours() orders them: that of the neighbour one step (-1 or 1) along an
/// axis, where x is axis 2.
int64_t place_of(int axis, int64_t step) { return 1 + 2 * (2 - axis) + (step > 0); }

/// Tells, point by point, whether a stencil of nearest neighbours is a sum over the axes, and of which matrices.
template <class T>
class SeparableStencil {
 public:
  explicit SeparableStencil(const PackedStencil<T>& a)
      : a_(a), n_(a.grid().shape), slack_(slack_of_sum(a.norm(), std::numeric_limits<T>::epsilon())) {}

  /// A_d, as it is on the line of points through the middle, which no side holds.
  Eigen::MatrixXd along(int axis) const {
    const int64_t n = n_[axis];
    Eigen::MatrixXd matrix = Eigen::MatrixXd::Zero(n, n);
    for (int64_t i = 0; i < n; ++i) {
      for (const int64_t step : {-1, 1})
        if (const auto j = neighbour(i, step, n, a_.grid().periodic[axis]); j >= 0)
          matrix(i, j) = at(axis, i, place_of(axis, step));
      if (a_.has_row_sums()) matrix(i, i) = row_sum_along(axis, i) - matrix.row(i).sum();
      else matrix(i, i) = at(axis, i, 0) - (axis == 2 ? 0.0 : at(axis, middle(axis), 0));
    }
    return matrix;
  }

  /// Whether every point couples to its neighbours as the matrices say, which the middle row agrees with.
  bool agrees_with(const SumOverAxes& sum) const {
    for (int64_t r = 0; r < a_.rows(); ++r) {
      const int64_t z = r / n_[1], y = r % n_[1];
      if (!a_.has_row_sums() && !matches_middle_row(r, 0, sum[0](z, z) + sum[1](y, y))) return false;
      for (const int64_t step : {-1, 1}) {
        if (!matches_middle_row(r, place_of(2, step), 0.0)) return false;
        if (!is_constant(r, sum[1], 1, y, step) || !is_constant(r, sum[0], 0, z, step)) return false;
      }
    }
    return true;
  }
  /// Whether the stored row sums are a sum over the axes; how they vary would pass for rounding beside a diagonal.
  bool row_sums_are_separable() const {
    if (!a_.has_row_sums()) return true;
    constexpr double slack = 16.0 * std::numeric_limits<T>::epsilon();
    const double of_middle = a_.row_sum(middle_row(), middle(2));
    for (int64_t r = 0; r < a_.rows(); ++r) {
      const double z = a_.row_sum(row_of(0, r / n_[1]), middle(2)), y = a_.row_sum(row_of(1, r % n_[1]), middle(2));
      for (int64_t i = 0; i < n_[2]; ++i) {
        const double row_sum = a_.row_sum(r, i), x = a_.row_sum(middle_row(), i);
        const double size = std::abs(row_sum) + std::abs(x) + std::abs(y) + std::abs(z) + std::abs(of_middle);
        if (!(std::abs(row_sum - (x + y + z - 2.0 * of_middle)) <= slack * size)) return false;
      }
    }
    return true;
  }
  /// Whether the rows are of one size.
  bool has_even_rows() const {
    constexpr T widest = kWidestRows;
    T least = std::numeric_limits<T>::infinity(), most = 0;
    for (int64_t r = 0; r < a_.rows(); ++r) {
      const T* diagonal = a_.coefficient(r, 0);
      for (int64_t i = 0; i < n_[2]; ++i) {
        least = std::min(least, std::abs(diagonal[i]));
        most = std::max(most, std::abs(diagonal[i]));
      }
    }
    return most <= widest * least;
  }
  bool is_symmetric(const Eigen::MatrixXd& matrix) const { return kernels::is_symmetric(matrix, slack_); }

 private:
  int64_t middle(int axis) const { return n_[axis] / 2; }
  int64_t middle_row() const { return middle(0) * n_[1] + middle(1); }
  /// The row of point i on the line along an axis through the middle.
  int64_t row_of(int axis, int64_t i) const {
    return (axis == 0 ? i : middle(0)) * n_[1] + (axis == 1 ? i : middle(1));
  }
  double at(int axis, int64_t i, int64_t k) const {
    const int64_t row = row_of(axis, i), x = axis == 2 ? i : middle(2);
    return k == 0 ? a_.diagonal(row, x) : static_cast<double>(a_.value(row, k, x));
  }
  /// The row sums of A_d, so that those of all axes add up to what is stored.
  double row_sum_along(int axis, int64_t i) const {
    if (axis == 2) return a_.row_sum(middle_row(), i);
    return a_.row_sum(row_of(axis, i), middle(2)) - a_.row_sum(middle_row(), middle(2));
  }
  /// How far a coefficient may be from this one: relative to itself where row sums are stored, else to ‖A‖, as it then
  /// adds to a diagonal.
  double slack_of(double coefficient) const {
    return a_.has_row_sums() ? 16.0 * std::numeric_limits<T>::epsilon() * std::abs(coefficient) : slack_;
  }
  /// Whether coefficient k of row r is that of the middle row plus `shift`.
  bool matches_middle_row(int64_t r, int64_t k, double shift) const {
    const int64_t last = n_[2] - 1, middle = middle_row();
    for (const int64_t end : {int64_t{0}, last}) {
      const double expected = a_.value(middle, k, end);
      if (!(std::abs(a_.value(r, k, end) - expected - shift) <= slack_of(expected))) return false;
    }
    const T *row = a_.coefficient(r, k), *of_middle = a_.coefficient(middle, k);
    if (a_.has_row_sums()) {
      for (int64_t i = 1; i < last; ++i)
        if (!(std::abs(row[i] - of_middle[i]) <= slack_of(static_cast<double>(of_middle[i])))) return false;
      return true;
    }
    return all_within(1, last, slack_,
                      [&, added = static_cast<T>(shift)](int64_t i) { return row[i] - of_middle[i] - added; });
  }
  /// Whether the coefficient of the neighbour along another axis than x is the same at all points of a row.
  bool is_constant(int64_t r, const Eigen::MatrixXd& matrix, int axis, int64_t i, int64_t step) const {
    if (n_[axis] == 1) return true;
    const auto j = neighbour(i, step, n_[axis], a_.grid().periodic[axis]);
    if (j < 0) return true;  // what points beyond the grid couples to nothing
    const T* row = a_.coefficient(r, place_of(axis, step));
    return all_within(0, n_[2], slack_of(matrix(i, j)),
                      [row, value = static_cast<T>(matrix(i, j))](int64_t x) { return row[x] - value; });
  }
  template <class Difference>
  bool all_within(int64_t first, int64_t end, double most, const Difference& difference) const {
    const auto slack = static_cast<T>(most);
    int farther = 0;  // no early return, so that it becomes vector code
    for (int64_t i = first; i < end; ++i) farther |= !(std::abs(difference(i)) <= slack);
    return farther == 0;
  }

  const PackedStencil<T>& a_;
  const int64_t* n_;
  double slack_;
};

}  // namespace

template <class T>
std::optional<SumOverAxes> as_sum_over_axes(const PackedStencil<T>& a) {
  const auto& grid = a.grid();
  if (!has_axes_to_diagonalise(grid.dim, grid.shape) || !a.pattern().nearest) return std::nullopt;
  const SeparableStencil<T> separable(a);
  if (!separable.has_even_rows() || !separable.row_sums_are_separable()) return std::nullopt;
  SumOverAxes sum;
  for (int d = 0; d < 3; ++d) {
    const bool is_there = d >= 3 - grid.dim;
    sum[d] = is_there ? separable.along(d) : Eigen::MatrixXd(Eigen::MatrixXd::Zero(1, 1));
    if (!separable.is_symmetric(sum[d])) return std::nullopt;
  }
  return separable.agrees_with(sum) ? std::optional(std::move(sum)) : std::nullopt;
}

template std::optional<SumOverAxes> as_sum_over_axes(const PackedStencil<float>&);
template std::optional<SumOverAxes> as_sum_over_axes(const PackedStencil<double>&);

}  // namespace prdp::kernels
