#include "prdp/kernels/fast_diagonalisation.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>
#include <numeric>

namespace prdp::kernels {

namespace {

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
template std::shared_ptr<const FastDiagonalisation<float>> fast_diagonalisation(const PackedStencil<float>&,
                                                                                const FactorKey&, int64_t);
template std::shared_ptr<const FastDiagonalisation<double>> fast_diagonalisation(const PackedStencil<double>&,
                                                                                 const FactorKey&, int64_t);

}  // namespace prdp::kernels
