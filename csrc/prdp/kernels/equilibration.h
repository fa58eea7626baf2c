#pragma once
#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <vector>

namespace prdp::kernels {

/// Powers of two for the rows and columns of a matrix that bring its entries to one size, so that what is small can be
/// told from what is rounding. They change no digit.
struct Equilibration {
  Eigen::VectorXd rows, columns;
  /// Whether the sizes differ so much that factors of the scaled matrix may tell more than those of the given one.
  bool matters() const {
    constexpr double ordinary = 64.0;
    const auto spread = [](const Eigen::VectorXd& scales) { return scales.maxCoeff() / scales.minCoeff(); };
    return rows.size() > 0 && spread(rows) * spread(columns) > ordinary;
  }
};

/// Those of a matrix of n rows and columns; `for_each_entry(body)` calls body(i, j, value). First the mean of the
/// logarithms of every row and column becomes zero, by turns (Curtis and Reid, J. Inst. Maths Applics 1972): that does
/// not depend on how the matrix was scaled. Then its sums of magnitudes become one (Sinkhorn): few large entries count
/// for more than many small ones.
template <class ForEachEntry>
Equilibration equilibrate(int64_t n, const ForEachEntry& for_each_entry) {
  struct Entry {
    int64_t i, j;
    double log;
  };
  std::vector<Entry> entries;
  for_each_entry([&](int64_t i, int64_t j, double value) {
    if (value != 0.0) entries.push_back({i, j, std::log2(std::abs(value))});
  });
  Eigen::VectorXd rows = Eigen::VectorXd::Zero(n), columns = rows, sum(n), count(n);
  const auto size = [&](const Entry& e) { return std::min(e.log + rows[e.i] + columns[e.j], 1000.0); };
  const auto take_off_means = [&](Eigen::VectorXd& of, int64_t Entry::* line) {
    sum.setZero();
    count.setZero();
    for (const auto& e : entries) sum[e.*line] += size(e), ++count[e.*line];
    of.array() -= sum.array() / count.array().max(1.0);
  };
  const auto take_off_sums = [&](Eigen::VectorXd& of, int64_t Entry::* line) {
    sum.setZero();
    for (const auto& e : entries) sum[e.*line] += std::exp2(size(e));
    of.array() -= (sum.array() > 0.0).select(sum.array().log() / std::log(2.0), 0.0);
  };
  for (int pass = 0; pass < 20; ++pass) {
    take_off_means(rows, &Entry::i);
    take_off_means(columns, &Entry::j);
  }
  for (int pass = 0; pass < 10; ++pass) {
    take_off_sums(rows, &Entry::i);
    take_off_sums(columns, &Entry::j);
  }
  const auto powers = [](const Eigen::VectorXd& exponents) -> Eigen::VectorXd {
    return exponents.array().round().max(-1000.0).min(1000.0).unaryExpr([](double e) { return std::exp2(e); });
  };
  return {powers(rows), powers(columns)};
}

}  // namespace prdp::kernels
