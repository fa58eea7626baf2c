#include "prdp/kernels/fast_diagonalisation.h"

#include <cmath>
#include <limits>
#include <numbers>
#include <numeric>

namespace prdp::kernels {

namespace {

/// Coefficients as StencilSparsity::nearest_neighbours() orders them: that of the neighbour one step (-1 or 1) along an
/// axis, where x is axis 2.
int64_t place_of(int axis, int64_t step) { return 1 + 2 * (2 - axis) + (step > 0); }

/// Reads a stencil of nearest neighbours point by point.
template <class T>
class Reader {
 public:
  explicit Reader(const PackedStencil<T>& a)
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
    const double there = a_.row_sum(middle_row(), middle(2));
    for (int64_t r = 0; r < a_.rows(); ++r) {
      const double z = a_.row_sum(row_of(0, r / n_[1]), middle(2)), y = a_.row_sum(row_of(1, r % n_[1]), middle(2));
      for (int64_t i = 0; i < n_[2]; ++i) {
        const double row_sum = a_.row_sum(r, i), x = a_.row_sum(middle_row(), i);
        const double size = std::abs(row_sum) + std::abs(x) + std::abs(y) + std::abs(z) + std::abs(there);
        if (!(std::abs(row_sum - (x + y + z - 2.0 * there)) <= slack * size)) return false;
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

template <class T>
typename AxisProducts<T>::Matrices rounded(const SumOverAxes& matrices) {
  typename AxisProducts<T>::Matrices all;
  for (int d = 0; d < 3; ++d) all[d] = matrices[d].template cast<T>();
  return all;
}

/// The eigenvectors of the A_d, as columns, and their eigenvalues.
struct Eigenpairs {
  SumOverAxes eigenvectors;
  std::array<Eigen::VectorXd, 3> eigenvalues;
};

Eigenpairs eigenpairs(const SumOverAxes& a) {
  Eigenpairs found;
  for (int d = 2; d >= 0; --d) {
    if (d < 2 && a[d].rows() == a[d + 1].rows() && a[d] == a[d + 1]) {
      found.eigenvectors[d] = found.eigenvectors[d + 1];
      found.eigenvalues[d] = found.eigenvalues[d + 1];
      continue;
    }
    const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> solver(a[d]);
    found.eigenvectors[d] = solver.eigenvectors();
    found.eigenvalues[d] = solver.eigenvalues();
  }
  return found;
}

/// Whether each row of A_d is the one before it, moved on by a point, up to rounding.
bool is_circulant(const Eigen::MatrixXd& a, double epsilon) {
  const double slack = 16.0 * epsilon * a.cwiseAbs().maxCoeff();
  const auto n = a.rows();
  for (Eigen::Index i = 0; i < n; ++i)
    for (Eigen::Index j = 0; j < n; ++j)
      if (!(std::abs(a(i, j) - a(0, (j - i + n) % n)) <= slack)) return false;
  return true;
}

/// The eigenvalues of a symmetric circulant matrix, in the order of the wavenumbers.
Eigen::VectorXd circulant_eigenvalues(const Eigen::MatrixXd& a) {
  const auto n = a.rows();
  const Eigen::VectorXd cosines =
      (Eigen::VectorXd::LinSpaced(n, 0, static_cast<double>(n - 1)) * (2.0 * std::numbers::pi / static_cast<double>(n)))
          .array()
          .cos();
  Eigen::VectorXd values = Eigen::VectorXd::Constant(n, a(0, 0));
  for (Eigen::Index j = 1; j < n; ++j)
    if (a(0, j) != 0.0)
      for (Eigen::Index k = 0; k < n; ++k) values(k) += a(0, j) * cosines(j * k % n);
  return values;
}

/// The inverses of all eigenvalues, zero for the `null_vectors` smallest ones; nothing if others vanish too.
std::optional<std::vector<double>> inverted(const std::array<Eigen::VectorXd, 3>& eigenvalues, int64_t null_vectors) {
  std::vector<double> values;
  for (const double z : eigenvalues[0])
    for (const double y : eigenvalues[1])
      for (const double x : eigenvalues[2]) values.push_back(z + y + x);
  std::vector<size_t> order(values.size());
  std::iota(order.begin(), order.end(), size_t{0});
  const auto least = std::min(null_vectors + 1, std::ssize(order));
  const auto smaller = [&](size_t i, size_t j) { return std::abs(values[i]) < std::abs(values[j]); };
  std::partial_sort(order.begin(), order.begin() + least, order.end(), smaller);

  double largest = 0.0;
  for (const double value : values) largest = std::max(largest, std::abs(value));
  int64_t longest = 1;
  for (const auto& of_axis : eigenvalues) longest = std::max(longest, int64_t{of_axis.size()});
  const double rounding = static_cast<double>(longest) * std::numeric_limits<double>::epsilon() * largest;
  if (null_vectors >= std::ssize(order) || !(std::abs(values[order[null_vectors]]) > rounding)) return std::nullopt;
  for (double& value : values) value = 1.0 / value;
  for (int64_t i = 0; i < null_vectors; ++i) values[order[i]] = 0.0;
  return values;
}

}  // namespace

bool has_axes_to_diagonalise(int64_t dim, const int64_t* shape) {
  constexpr int64_t longest = 2048;
  return std::all_of(shape + 3 - dim, shape + 3, [](int64_t n) { return n >= 3 && n <= longest; });
}

bool is_symmetric(const Eigen::MatrixXd& a, double slack) { return (a - a.transpose()).cwiseAbs().maxCoeff() <= slack; }

DiagonalisedSum diagonalise(const SumOverAxes& a, double epsilon, int64_t null_vectors) {
  if (is_circulant(a[0], epsilon) && is_circulant(a[1], epsilon) && is_circulant(a[2], epsilon))
    return {std::nullopt,
            inverted({circulant_eigenvalues(a[0]), circulant_eigenvalues(a[1]), circulant_eigenvalues(a[2])},
                     null_vectors)};
  auto found = eigenpairs(a);
  auto inverse = inverted(found.eigenvalues, null_vectors);
  return {std::move(found.eigenvectors), std::move(inverse)};
}

template <class T>
std::optional<SumOverAxes> as_sum_over_axes(const PackedStencil<T>& a) {
  const auto& grid = a.grid();
  if (!has_axes_to_diagonalise(grid.dim, grid.shape) || !a.pattern().nearest) return std::nullopt;
  const Reader<T> reader(a);
  if (!reader.has_even_rows() || !reader.row_sums_are_separable()) return std::nullopt;
  SumOverAxes sum;
  for (int d = 0; d < 3; ++d) {
    const bool is_there = d >= 3 - grid.dim;
    sum[d] = is_there ? reader.along(d) : Eigen::MatrixXd(Eigen::MatrixXd::Zero(1, 1));
    if (!reader.is_symmetric(sum[d])) return std::nullopt;
  }
  return reader.agrees_with(sum) ? std::optional(std::move(sum)) : std::nullopt;
}

template <class T>
FastDiagonalisation<T>::FastDiagonalisation(const SumOverAxes& a, int64_t null_vectors) {
  const auto [eigenvectors, inverse] = diagonalise(a, std::numeric_limits<T>::epsilon(), null_vectors);
  if (!inverse) return;
  if (eigenvectors) made_ = Products{AxisProducts<T>(rounded<T>(*eigenvectors)), {inverse->begin(), inverse->end()}};
  else made_ = FourierMultiplier<T>({a[0].rows(), a[1].rows(), a[2].rows()}, *inverse);
}

template <class T>
void FastDiagonalisation<T>::solve(std::vector<T>& field) const {
  if (const auto* waves = std::get_if<FourierMultiplier<T>>(&made_)) return waves->apply(field);
  const auto& products = std::get<Products>(made_);
  static thread_local std::vector<T> other;
  other.resize(field.size());
  products.eigenvectors.apply(field, other, /*transposed=*/true);
  for_each_block_of(std::ssize(field), [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) field[i] *= products.inverse[i];
  });
  products.eigenvectors.apply(field, other, /*transposed=*/false);
}

template <class T>
int64_t FastDiagonalisation<T>::bytes() const {
  if (const auto* waves = std::get_if<FourierMultiplier<T>>(&made_)) return waves->bytes();
  if (!is_regular()) return 0;
  const auto& [eigenvectors, inverse] = std::get<Products>(made_);
  return eigenvectors.bytes() + static_cast<int64_t>(inverse.size() * sizeof(T));
}

template <class T>
std::shared_ptr<const FastDiagonalisation<T>> fast_diagonalisation(const PackedStencil<T>& a, const FactorKey& key,
                                                                   int64_t null_vectors) {
  using Solver = FastDiagonalisation<T>;
  const auto of_both = FactorKeyMaker().add(key).add(null_vectors).key();
  // The key tells the matrix: what was found to be a sum before is not looked at again.
  if (const auto kept = factor_cache::find(of_both, typeid(Solver)))
    return std::static_pointer_cast<const Solver>(kept);
  const auto sum = as_sum_over_axes(a);
  if (!sum) return nullptr;
  return factor_cache::find_or_make<Solver>(of_both, [&] { return std::make_shared<Solver>(*sum, null_vectors); });
}

template class FastDiagonalisation<float>;
template class FastDiagonalisation<double>;
template std::optional<SumOverAxes> as_sum_over_axes(const PackedStencil<float>&);
template std::optional<SumOverAxes> as_sum_over_axes(const PackedStencil<double>&);
template std::shared_ptr<const FastDiagonalisation<float>> fast_diagonalisation(const PackedStencil<float>&,
                                                                                const FactorKey&, int64_t);
template std::shared_ptr<const FastDiagonalisation<double>> fast_diagonalisation(const PackedStencil<double>&,
                                                                                 const FactorKey&, int64_t);

}  // namespace prdp::kernels
