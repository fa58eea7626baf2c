#pragma once
#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>

#include "prdp/kernels/stencil_sparsity.h"
#include "prdp/kernels/vector.h"

namespace prdp::kernels {

/// The coefficients of a stencil on one field as the loops take them. Whoever assembles them fills the rows
/// as if each were closed in itself, then calls close(): what leaves a row goes where the loops expect it.
template <class T>
class PackedStencil {
 public:
  /// All zero; `pattern` says which neighbours there are.
  explicit PackedStencil(std::shared_ptr<const StencilSparsity> pattern)
      : pattern_(std::move(pattern)),
        nx_(pattern_->grid.shape[2]),
        row_(round_up_to_lanes<T>(nx_)),
        count_(static_cast<int64_t>(pattern_->offsets.size())),
        wrap_count_(!pattern_->grid.periodic[2] ? 0
                    : pattern_->nearest         ? 2 * kLanes<T>
                                                : static_cast<int64_t>(pattern_->wraps.size())),
        memory_(zeros<T>(rows() * (count_ * row_ + wrap_count_) + kLanes<T>)) {
    const auto address = reinterpret_cast<std::uintptr_t>(memory_.data());
    coefficients_ = reinterpret_cast<T*>((address + 63) / 64 * 64);
  }
  PackedStencil(PackedStencil&&) = default;  // a copy would lie at another alignment
  PackedStencil& operator=(PackedStencil&&) = default;

  const StencilSparsity& pattern() const { return *pattern_; }
  const StencilGrid& grid() const { return pattern_->grid; }
  int64_t rows() const { return grid().shape[0] * grid().shape[1]; }
  /// From a coefficient at a point to the same one in the next row.
  int64_t stride() const { return count_ * row_; }
  /// Coefficient k of row r.
  T* coefficient(int64_t r, int64_t k) { return coefficients_ + (r * count_ + k) * row_; }
  const T* coefficient(int64_t r, int64_t k) const { return coefficients_ + (r * count_ + k) * row_; }

  /// The same at point i; what leaves a periodic row along x is included.
  T value(int64_t r, int64_t k, int64_t i) const {
    const int64_t x = pattern_->offsets[k].along[2];
    const bool leaves = i + x < 0 || i + x >= nx_;
    return leaves && grid().periodic[2] ? wrapped(r, k, i) : coefficient(r, k)[i];
  }

  void close() {
    for_each_run_of_rows(rows(), row_, [&](int64_t begin, int64_t end) {
      for (int64_t r = begin; r < end; ++r) close_row(r);
    });
  }

  /// Of nearest neighbours: stores the row sums s_i, one for all points or one for each. Products are then evaluated as
  /// s_i v_i + Σ_k a_k (v_k - v_i), so that rounding of the diagonal cannot change a row sum.
  void set_row_sums(const T* values, bool is_number, T factor) {
    row_sum_step_ = is_number ? 0 : row_;
    row_sums_ = zeros<T>(is_number ? row_ : rows() * row_);
    for (int64_t r = 0; r < (is_number ? 1 : rows()); ++r)
      for (int64_t i = 0; i < nx_; ++i) row_sums_[r * row_ + i] = factor * values[is_number ? 0 : r * nx_ + i];
  }
  /// Of point i of row r: a coupling to a zero beyond the grid belongs to the row sum.
  void add_to_row_sum(int64_t r, int64_t i, T by) {
    if (by == T(0)) return;
    if (row_sum_step_ == 0) {
      Field<T> of_rows = zeros<T>(rows() * row_);
      for (int64_t k = 0; k < rows(); ++k) std::copy_n(row_sums_.data(), row_, of_rows.data() + k * row_);
      row_sums_ = std::move(of_rows);
      row_sum_step_ = row_;
    }
    row_sums_[r * row_ + i] += by;
  }
  /// Whether row sums are stored.
  bool has_row_sums() const { return !row_sums_.empty(); }
  /// True if all row sums are >= 0 and one is > 0; false if none are stored.
  bool is_surely_definite() const {
    if (row_sums_.empty()) return false;
    const auto [least, most] = std::minmax_element(row_sums_.begin(), row_sums_.end());
    return *least >= T(0) && *most > T(0);
  }
  /// The largest entry on the diagonal over the smallest.
  double spread() const {
    double least = std::numeric_limits<double>::infinity(), most = 0.0;
    for (int64_t r = 0; r < rows(); ++r)
      for (int64_t i = 0; i < nx_; ++i) {
        const double size = std::abs(diagonal(r, i));
        least = std::min(least, size);
        most = std::max(most, size);
      }
    return most / least;
  }
  /// Whether the sums of A x and b over the grid agree to a few thousandths of Σ|b|. That of A x is Σ (row sum) x, as A
  /// is symmetric where it has row sums.
  bool sums_agree(const T* x, const T* b) const {
    double sum = 0.0, size = 0.0;
    for (int64_t r = 0; r < rows(); ++r)
      for (int64_t i = 0; i < nx_; ++i) {
        sum += row_sum(r, i) * static_cast<double>(x[r * row_ + i]) - static_cast<double>(b[r * row_ + i]);
        size += std::abs(static_cast<double>(b[r * row_ + i]));
      }
    return std::abs(sum) <= 2e-3 * size;
  }
  double row_sum(int64_t r, int64_t i) const { return static_cast<double>(row_sums_[r * row_sum_step_ + i]); }
  /// The entry of the matrix on its diagonal at point i of row r.
  double diagonal(int64_t r, int64_t i) const {
    if (row_sums_.empty()) return static_cast<double>(coefficient(r, 0)[i]);
    double sum = row_sum(r, i);
    for (int64_t k = 1; k < count_; ++k) sum -= static_cast<double>(value(r, k, i));
    return sum;
  }

  /// On these rows: out = A v; dots += {v·out, ‖out‖²} unless it is null.
  void apply(Lines lines, const T* v, T* out, T* dots) const {
    const auto& loops = kernels::loops<T>();
    if (pattern_->nearest) loops.apply_neighbours[grid().dim - 1](neighbours(), lines, v, out, dots);
    else loops.apply_offsets(offsets(), lines, v, out, dots);
  }
  /// A Jacobi sweep y = x + c - D⁻¹A x; *squares += ‖D(y - x)‖² unless it is null.
  void sweep(Lines lines, const T* c, const T* x, T* y, T* squares) const {
    const auto& loops = kernels::loops<T>();
    if (pattern_->nearest) loops.sweep_neighbours[grid().dim - 1](neighbours(), lines, c, x, y, squares);
    else loops.sweep_offsets(offsets(), lines, c, x, y, squares);
  }
  /// A smoothing step y = x + p (x - y) + q D⁻¹(b - A x); and r = b - A x.
  void smooth(Lines lines, const T* b, const T* x, T* y, T p, T q) const {
    const auto& loops = kernels::loops<T>();
    if (pattern_->nearest) loops.smooth_neighbours[grid().dim - 1](neighbours(), lines, b, x, y, p, q);
    else loops.smooth_offsets(offsets(), lines, b, x, y, p, q);
  }
  void residual(Lines lines, const T* b, const T* x, T* r) const {
    const auto& loops = kernels::loops<T>();
    if (pattern_->nearest) loops.residual_neighbours[grid().dim - 1](neighbours(), lines, b, x, r);
    else loops.residual_offsets(offsets(), lines, b, x, r);
  }
  /// The same for the loops of operators that hold several stencils of nearest neighbours.
  NeighbourStencil<T> neighbours() const {
    const auto& n = grid().shape;
    return {n[0],
            n[1],
            nx_,
            row_,
            coefficients_,
            wrap_count_ ? wrap_values(0) : nullptr,
            row_sums_.empty() ? nullptr : row_sums_.data(),
            row_sum_step_};
  }

  int64_t bytes() const { return static_cast<int64_t>((memory_.size() + row_sums_.size()) * sizeof(T)); }
  /// max_i Σ_j |A_ij|
  double norm() const {
    std::vector<T> sums(nx_);
    T largest = 0;
    for (int64_t r = 0; r < rows(); ++r) {
      std::fill(sums.begin(), sums.end(), T(0));
      for (int64_t k = 0; k < count_; ++k) {
        const T* row = coefficient(r, k);
        for (int64_t i = 0; i < nx_; ++i) sums[i] += std::abs(row[i]);
      }
      for (size_t e = 0; e < pattern_->wraps.size(); ++e) sums[pattern_->wraps[e].to] += std::abs(wrap_values(r)[e]);
      if (pattern_->nearest && wrap_count_) {
        sums[0] += std::abs(wrap_values(r)[0]);
        sums[nx_ - 1] += std::abs(wrap_values(r)[kLanes<T> + (nx_ - 1) % kLanes<T>]);
      }
      largest = std::max(largest, largest_magnitude(sums.data(), nx_));
    }
    return static_cast<double>(largest);
  }
  /// Calls body(row of the grid, coefficient, point of the row, value) for all coefficients, those that leave a
  /// periodic row along x included.
  template <class Body>
  void for_each_coefficient(const Body& body) const {
    for (int64_t r = 0; r < rows(); ++r)
      for (int64_t k = 0; k < count_; ++k)
        for (int64_t i = 0; i < nx_; ++i) body(r, k, i, value(r, k, i));
  }
  /// Calls body(row, column, value in double) for the entries of the matrix; where nearest neighbours coincide they
  /// come one by one.
  template <class Body>
  void for_each_entry(const Body& body) const {
    const auto& [nz, ny, nx] = grid().shape;
    const auto& periodic = grid().periodic;
    for (int64_t r = 0; r < rows(); ++r)
      for (int64_t k = 0; k < count_; ++k) {
        const auto& o = pattern_->offsets[k].along;
        const int64_t z = neighbour(r / ny, o[0], nz, periodic[0]), y = neighbour(r % ny, o[1], ny, periodic[1]);
        if (z < 0 || y < 0) continue;
        const int64_t begin = std::max<int64_t>(-o[2], 0), end = std::min(nx, nx - o[2]);
        const int64_t at = r * nx, there = (z * ny + y) * nx;
        const auto entry = [&](int64_t i) { return k == 0 ? diagonal(r, i) : static_cast<double>(value(r, k, i)); };
        for (int64_t i = begin; i < end; ++i) body(at + i, there + i + o[2], entry(i));
        if (!periodic[2]) continue;
        for (int64_t i = 0; i < begin; ++i) body(at + i, there + i + o[2] + nx, entry(i));
        for (int64_t i = end; i < nx; ++i) body(at + i, there + i + o[2] - nx, entry(i));
      }
  }

 private:
  void close_row(int64_t r) {
    T* const to = wrap_values(r);
    for (size_t e = 0; e < pattern_->wraps.size(); ++e)
      to[e] = coefficient(r, pattern_->wraps[e].coefficient)[pattern_->wraps[e].to];
    if (pattern_->nearest && wrap_count_) {
      to[0] = coefficient(r, 1)[0];
      to[kLanes<T> + (nx_ - 1) % kLanes<T>] = coefficient(r, 2)[nx_ - 1];
    }
    if (row_ > nx_) std::fill(coefficient(r, 0) + nx_, coefficient(r, 0) + row_, T(1));
    for (int64_t k = 0; k < count_; ++k) {
      const int64_t x = pattern_->offsets[k].along[2];
      for (int64_t i = 0; i < -x; ++i) coefficient(r, k)[i] = T(0);
      for (int64_t i = nx_ - x; i < nx_; ++i) coefficient(r, k)[i] = T(0);
    }
  }

  const T* wrap_values(int64_t r) const { return coefficients_ + rows() * stride() + r * wrap_count_; }
  T* wrap_values(int64_t r) { return coefficients_ + rows() * stride() + r * wrap_count_; }
  OffsetStencil<T> offsets() const {
    const auto& n = grid().shape;
    return {n[0],          n[1],        nx_,
            row_,          count_,      pattern_->offsets.data(),
            coefficients_, wrap_count_, pattern_->wraps.data(),
            wrap_values(0)};
  }

  /// What couples point i to the one at offset x along its own row, which leaves the row.
  T wrapped(int64_t r, int64_t k, int64_t i) const {
    if (pattern_->nearest) return wrap_values(r)[k == 1 ? 0 : kLanes<T> + i % kLanes<T>];
    const auto& wraps = pattern_->wraps;
    size_t e = 0;
    while (wraps[e].coefficient != k || wraps[e].to != i) ++e;
    return wrap_values(r)[e];
  }

  std::shared_ptr<const StencilSparsity> pattern_;
  int64_t nx_, row_, count_;
  int64_t wrap_count_;  // numbers of a row for what leaves it: the wraps of an OffsetStencil, or ends
  Field<T> memory_;
  Field<T> row_sums_;  // see set_row_sums()
  int64_t row_sum_step_ = 0;
  T* coefficients_;  // aligned, within memory_, with those values behind them
};

}  // namespace prdp::kernels
