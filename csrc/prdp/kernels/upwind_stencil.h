#pragma once
#include <algorithm>
#include <cmath>
#include <utility>

#include "prdp/kernels/vector.h"

namespace prdp::kernels {

/// An operator that depends on a velocity field, as plain arrays: the winds (batch, channel, ny, nx) on
/// a periodic grid; ny = 1 in one dimension.
template <class T>
struct UpwindParameters {
  const T* winds;
  int64_t sample_stride;  // 0: all samples share them
  int64_t ny, nx;
  double nu, dt;
  bool transposed;
  double length_y = 1.0, length_x = 1.0;  // of the domain

  UpwindParameters sample(int64_t s) const {
    UpwindParameters p = *this;
    p.winds += s * sample_stride;
    p.sample_stride = 0;
    return p;
  }
};

/// The winds that act along one axis on one row of the grid: at its points and to either side of them,
/// each nx values.
template <class T>
struct WindRow {
  const T *before, *here, *after;
};

/// shift·I + advection·Γ - diffusion·L of one scalar field on a periodic grid, or its transpose: upwind
/// differences Γ = Σ diag(max(w⁻, 0)) B + diag(min(w⁺, 0)) F and the Laplacian L. Rows need no zeros
/// between them. Along an axis of one point all differences vanish.
template <class T, int Dim>
class UpwindStencil {
 public:
  struct Terms {
    double shift, advection, diffusion;
    bool transposed;
    double length_y = 1.0, length_x = 1.0;
  };

  /// `winds(axis, j, scratch)` is the WindRow along the axis (0: x, 1: y) at row j; it may lie in
  /// scratch, which holds nx + 2 values.
  template <class Winds>
  UpwindStencil(int64_t ny, int64_t nx, const Terms& terms, const Winds& winds)
      : ny_(ny), nx_(nx), row_(round_up_to_lanes<T>(nx)), transposed_(terms.transposed),
        memory_((ny * kCoefficients + 3) * row_ + 2 * ny + 2 * kLanes<T>, T(0)) {
    const auto address = reinterpret_cast<std::uintptr_t>(memory_.data());
    coefficients_ = reinterpret_cast<T*>((address + 63) / 64 * 64);
    T* scratch = coefficients_ + ny * kCoefficients * row_;
    wraps_ = scratch + 3 * row_ + kLanes<T>;
    for (int64_t j = 0; j < ny; ++j) assemble_row(j, terms, winds, scratch);
    norm_ = largest_row_sum(scratch);
  }
  UpwindStencil(UpwindStencil&&) = default;  // a copy would lie at another alignment

  double norm() const { return norm_; }
  const T* diagonal(int64_t j) const { return coefficient(j, 0); }
  PeriodicStencil<T> stencil() const { return {ny_, nx_, row_, coefficients_, wraps_}; }

  /// Calls body(row, column, value) for the entries of the matrix as applied; where neighbours
  /// coincide they come one by one.
  template <class Body>
  void for_each_entry(const Body& body) const {
    for (int64_t j = 0; j < ny_; ++j) {
      const int64_t at = j * nx_, below = previous(j) * nx_, above = next(j) * nx_;
      for (int64_t i = 0; i < nx_; ++i) {
        body(at + i, at + i, coefficient(j, 0)[i]);
        if (i > 0) body(at + i, at + i - 1, coefficient(j, 1)[i]);
        if (i + 1 < nx_) body(at + i, at + i + 1, coefficient(j, 2)[i]);
        if (Dim == 1) continue;
        body(at + i, below + i, coefficient(j, 3)[i]);
        body(at + i, above + i, coefficient(j, 4)[i]);
      }
      body(at, at + nx_ - 1, wraps_[2 * j]);
      body(at + nx_ - 1, at, wraps_[2 * j + 1]);
    }
  }

 private:
  static constexpr int64_t kCoefficients = 2 * Dim + 1;

  /// Coefficient k of row j: centre, x lower, x upper, y lower, y upper.
  T* coefficient(int64_t j, int64_t k) const { return coefficients_ + (j * kCoefficients + k) * row_; }
  int64_t previous(int64_t j) const { return j > 0 ? j - 1 : ny_ - 1; }
  int64_t next(int64_t j) const { return j + 1 < ny_ ? j + 1 : 0; }

  /// What couples row j to its neighbours; in the transpose that belongs to the neighbours.
  template <class Winds>
  void assemble_row(int64_t j, const Terms& terms, const Winds& winds, T* scratch) {
    const auto& loops = kernels::loops<T>();
    const auto couple = [&](int axis, double inverse_dx, T* lower, T* upper, T* winds_memory) {
      const WindRow<T> w = winds(axis, j, winds_memory);
      loops.upwind_row(static_cast<T>(terms.advection * inverse_dx),
                       static_cast<T>(terms.diffusion * inverse_dx * inverse_dx), w.before, w.here, w.after,
                       lower, upper, coefficient(j, 0), nx_);
    };
    std::fill(coefficient(j, 0), coefficient(j, 0) + nx_, static_cast<T>(terms.shift));
    const double inverse_dx = static_cast<double>(nx_) / terms.length_x;
    const double inverse_dy = static_cast<double>(ny_) / terms.length_y;
    if (nx_ > 1) {
      couple(0, inverse_dx, scratch, scratch + row_, scratch + 2 * row_);
      place_along_row(j, scratch, scratch + row_);
    }
    if (Dim == 1 || ny_ == 1) return;
    if (transposed_)
      couple(1, inverse_dy, coefficient(previous(j), 4), coefficient(next(j), 3), scratch + 2 * row_);
    else
      couple(1, inverse_dy, coefficient(j, 3), coefficient(j, 4), scratch + 2 * row_);
  }
  void place_along_row(int64_t j, const T* lower, const T* upper) {
    T *to_lower = coefficient(j, 1) + 1, *to_upper = coefficient(j, 2), *wraps = wraps_ + 2 * j;
    wraps[0] = lower[0];
    wraps[1] = upper[nx_ - 1];
    if (transposed_) std::swap(wraps[0], wraps[1]);
    std::copy(lower + 1, lower + nx_, transposed_ ? to_upper : to_lower);
    std::copy(upper, upper + nx_ - 1, transposed_ ? to_lower : to_upper);
  }

  double largest_row_sum(T* sums) const {
    T largest = 0;
    for (int64_t j = 0; j < ny_; ++j) {
      std::fill(sums, sums + nx_, T(0));
      for (int64_t k = 0; k < kCoefficients; ++k)
        for (int64_t i = 0; i < nx_; ++i) sums[i] += std::abs(coefficient(j, k)[i]);
      sums[0] += std::abs(wraps_[2 * j]);
      sums[nx_ - 1] += std::abs(wraps_[2 * j + 1]);
      largest = std::max(largest, largest_magnitude(sums, nx_));
    }
    return static_cast<double>(largest);
  }

  int64_t ny_, nx_, row_;
  bool transposed_;
  std::vector<T> memory_;
  T *coefficients_, *wraps_;  // aligned, within memory_
  double norm_;
};

/// Vectors of `Channels` fields on a periodic grid in padded rows, and Jacobi's sweep, which follows
/// from the product and the diagonal.
template <class T, int Channels, class Kernel>
class PeriodicBase {
 public:
  using Scalar = T;

  explicit PeriodicBase(const UpwindParameters<T>& p)
      : parameters_(p), row_(round_up_to_lanes<T>(p.nx)),
        // max(w, 0) loses a NaN: it must be seen here.
        finite_(!is_shared() || std::isfinite(largest_magnitude(p.winds, kWinds * p.ny * p.nx))) {}
  bool is_shared() const { return parameters_.sample_stride == 0; }
  bool operator_is_finite() const { return finite_; }
  int64_t unknowns() const { return rows() * nx(); }
  int64_t length() const { return rows() * row_; }
  int64_t halo() const { return kLanes<T>; }

  /// dst = scale·src, from a contiguous sample into the padded layout; and back.
  void load(const T* src, T scale, T* dst) const {
    for (int64_t r = 0; r < rows(); ++r)
      for (int64_t i = 0; i < nx(); ++i) dst[r * row_ + i] = scale * src[r * nx() + i];
  }
  void store(const T* src, T scale, T* dst) const {
    for (int64_t r = 0; r < rows(); ++r)
      for (int64_t i = 0; i < nx(); ++i) dst[r * nx() + i] = scale * src[r * row_ + i];
  }

  /// c = D⁻¹ b
  void divide_by_diagonal(const T* b, T* c) const {
    for (int64_t r = 0; r < rows(); ++r) {
      const T* d = self().diagonal(r);
      for (int64_t i = 0; i < nx(); ++i) c[r * row_ + i] = b[r * row_ + i] / d[i];
    }
  }
  /// n Jacobi sweeps x ← x + D⁻¹(b - A x) with c = D⁻¹ b; y is memory that they use.
  void jacobi_sweeps(const T* c, T*& x, T*& y, int64_t n) const {
    for (; n > 0; --n, std::swap(x, y)) sweep<false>(c, x, y);
  }
  /// One of them, from x to y; returns ‖b - A x‖².
  T jacobi_sweep(const T* c, const T* x, T* y) const { return sweep<true>(c, x, y); }

 protected:
  int64_t nx() const { return parameters_.nx; }
  int64_t ny() const { return parameters_.ny; }
  int64_t rows() const { return Channels * ny(); }  // of all channels
  int64_t field() const { return ny() * row_; }     // padded length of one channel

  const Loops<T>& loops_ = kernels::loops<T>();
  UpwindParameters<T> parameters_;
  int64_t row_;
  bool finite_;

 private:
  template <bool Measure>
  T sweep(const T* c, const T* x, T* y) const {
    self().apply(x, y);
    T residual = 0;
    for (int64_t r = 0; r < rows(); ++r) {
      const T* d = self().diagonal(r);
      const int64_t at = r * row_;
      for (int64_t i = 0; i < nx(); ++i) {
        const T change = c[at + i] - y[at + i] / d[i];
        y[at + i] = x[at + i] + change;
        if constexpr (Measure) residual += d[i] * change * d[i] * change;
      }
    }
    return residual;
  }

  static constexpr int64_t kWinds = std::min(Channels, 2);

  const Kernel& self() const { return static_cast<const Kernel&>(*this); }
};

}  // namespace prdp::kernels
