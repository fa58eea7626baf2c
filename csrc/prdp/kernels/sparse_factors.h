#pragma once
#include <Eigen/Sparse>
#include <algorithm>
#include <memory>
#include <optional>
#include <vector>

#include "prdp/kernels/band_factors.h"
#include "prdp/kernels/factor_cache.h"
#include "prdp/kernels/null_space.h"

namespace prdp::kernels {

/// Unknowns that are held at zero, and equations that are left out, so that what is left of a matrix with known null
/// spaces is regular: as many of each as there are null vectors.
struct Pins {
  std::vector<int64_t> unknowns, equations;
};
/// Indices at which the vectors are far from linearly dependent.
std::vector<int64_t> pivots(std::vector<std::vector<double>> vectors);

/// Of a matrix in which the field with the null space begins at `first_entry`; none without a null space.
template <class T>
Pins pins_of(const std::optional<NullSpace<T>>& right, const std::optional<NullSpace<T>>& left, int64_t first_entry) {
  if (!right) return {};
  Pins pins{pivots(right->in_one_field()), pivots(left->in_one_field())};
  const auto count = std::min(pins.unknowns.size(), pins.equations.size());
  pins.unknowns.resize(count);
  pins.equations.resize(count);
  for (auto& i : pins.unknowns) i += first_entry;
  for (auto& i : pins.equations) i += first_entry;
  return pins;
}

/// Factors of a sparse matrix in double: of its band if that is narrow, else by Eigen: Cholesky's if the matrix is
/// symmetric and definite of either sign, which takes a quarter of the time, otherwise LU with pivoting. Any thread may
/// solve with them. Pivots are judged beside their own rows or columns, whose sizes may differ by any factor.
class SparseFactors {
 public:
  using Matrix = Eigen::SparseMatrix<double>;
  using Triplets = std::vector<Eigen::Triplet<double>>;

  SparseFactors(const Triplets& entries, int64_t n, const Pins& pins);
  ~SparseFactors();
  /// Whether all pivots are larger than the rounding errors of computing them.
  bool is_regular() const;
  /// x ← A⁻¹ x, or A⁻ᵀ x, for each column; several take less time together if gains_by_several().
  void solve(Eigen::Ref<Eigen::MatrixXd> x, bool transposed) const;
  bool gains_by_several() const;
  int64_t bytes() const;

 private:
  struct Factorised;
  template <int Count>
  using Block = Eigen::Ref<Eigen::Matrix<double, Eigen::Dynamic, Count>>;
  /// In blocks of Count columns, and then of fewer.
  template <int Count>
  void solve_side_by_side(Eigen::Ref<Eigen::MatrixXd> x, const Eigen::VectorXi& to_take, const Eigen::VectorXi& to_give,
                          bool transposed) const;
  template <int Count>
  void solve_block(Block<Count> x, const Eigen::VectorXi& to_take, const Eigen::VectorXi& to_give,
                   bool transposed) const;
  Eigen::VectorXi kept_unknowns_, kept_equations_;
  std::optional<BandFactors> band_;
  std::shared_ptr<const Factorised> factorised_;  // without a band
};

/// Those of a kernel, from the cache or made: kernel.for_each_entry(body), key() and transposed() tell the matrix. The
/// factors are those of the matrix that is not transposed.
template <class Kernel>
std::shared_ptr<const SparseFactors> sparse_factors(const Kernel& kernel, const FactorKey& matrix, bool transposed,
                                                    int64_t n, Pins pins) {
  if (transposed) std::swap(pins.unknowns, pins.equations);
  FactorKeyMaker key;
  key.add(matrix).add(pins.unknowns.data(), std::ssize(pins.unknowns));
  key.add(pins.equations.data(), std::ssize(pins.equations));
  return factor_cache::find_or_make<SparseFactors>(key.key(), [&] {
    SparseFactors::Triplets entries;
    kernel.for_each_entry([&](int64_t i, int64_t j, auto value) {
      if (transposed) std::swap(i, j);
      entries.emplace_back(static_cast<int>(i), static_cast<int>(j), static_cast<double>(value));
    });
    return std::make_shared<SparseFactors>(entries, n, pins);
  });
}

}  // namespace prdp::kernels
