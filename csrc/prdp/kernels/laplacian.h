#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "prdp/kernels/laplacian_parameters.h"
#include "prdp/kernels/loops.h"
#include "prdp/kernels/vector.h"

namespace prdp::kernels {

/// The Laplacian-type stencil on one sample, rows padded with zero lanes. A sample is stored in its
/// native order with at least one zero between rows, planes one zero row apart, and a zero halo in
/// front and behind, so that neighbours outside the grid read zero without a branch.
template <class T, int Dim>
class Laplacian {
 public:
  using Scalar = T;

  explicit Laplacian(const LaplacianParameters& p)
      : parameters_(p),
        nx_(p.shape[Dim - 1]),
        ny_(Dim > 1 ? p.shape[Dim - 2] : 1),
        nz_(Dim > 2 ? p.shape[Dim - 3] : 1),
        row_(round_up_to_lanes<T>(nx_ + 1)),
        plane_((Dim > 2 ? ny_ + 1 : ny_) * row_),
        centre_(static_cast<T>(p.centre)),
        apply_weights_(Dim * row_, T(0)),
        sweep_weights_(Dim * row_, T(0)) {
    norm_ = std::abs(p.centre);
    for (int d = 0; d < Dim; ++d) {
      const double off = p.off[Dim - 1 - d];
      norm_ += 2.0 * std::abs(off);
      std::fill_n(apply_weights_.begin() + d * row_, nx_, static_cast<T>(off));
      std::fill_n(sweep_weights_.begin() + d * row_, nx_, static_cast<T>(-off / p.centre));
    }
  }

  const LaplacianParameters& parameters() const { return parameters_; }
  bool is_shared() const { return true; }
  const Laplacian& sample(int64_t) const { return *this; }
  int64_t unknowns() const { return nz_ * ny_ * nx_; }
  int64_t length() const { return nz_ * plane_; }
  int64_t halo() const { return Dim == 1 ? kLanes<T> : Dim == 2 ? row_ : plane_; }
  double norm() const { return norm_; }
  bool operator_is_finite() const { return true; }
  bool has_zero_diagonal() const { return centre_ == T(0); }

  /// dst = scale·src, from a contiguous sample into the padded layout; and back.
  void load(const T* src, T scale, T* dst) const {
    for (int64_t z = 0; z < nz_; ++z)
      loops_.copy_rows(scale, src + z * ny_ * nx_, nx_, dst + z * plane_, row_, ny_, nx_);
  }
  void store(const T* src, T scale, T* dst) const {
    for (int64_t z = 0; z < nz_; ++z)
      loops_.copy_rows(scale, src + z * plane_, row_, dst + z * ny_ * nx_, nx_, ny_, nx_);
  }

  /// out = A v; returns v·out and ‖out‖².
  std::array<T, 2> apply(const T* v, T* out) const {
    std::array<T, 2> dots;
    loops_.apply[Dim - 1](stencil(apply_weights_), v, out, dots.data());
    return dots;
  }

  /// c = D⁻¹ b
  void divide_by_diagonal(const T* b, T* c) const { loops_.scale(T(1) / centre_, b, c, length()); }

  /// n sweeps x ← x + D⁻¹(b - A x) with c = D⁻¹ b; y is memory that they use. With omega, one for each,
  /// Chebyshev's x ← y + omega (that - y), where y holds the iterate before x, before and after.
  void jacobi_sweeps(const T* c, T*& x, T*& y, int64_t n, const T* omega = nullptr) const {
    if (loops_.sweeps[Dim - 1](stencil(sweep_weights_), c, x, y, n, omega) != x) std::swap(x, y);
  }
  /// One of them, from x to y; returns ‖b - A x‖².
  T jacobi_sweep(const T* c, const T* x, T* y, const T* omega = nullptr) const {
    const T change2 = loops_.sweep_and_measure[Dim - 1](stencil(sweep_weights_), c, x, y, omega);
    return centre_ * centre_ * change2;
  }
  /// The spectral radius of I - D⁻¹A.
  double radius() const { return jacobi_radius(parameters_); }

 private:
  PaddedStencil<T> stencil(const std::vector<T>& weights) const {
    return {ny_, nz_, row_, plane_, centre_, weights.data()};
  }

  const Loops<T>& loops_ = kernels::loops<T>();
  LaplacianParameters parameters_;
  int64_t nx_, ny_, nz_, row_, plane_;
  T centre_;
  double norm_;
  std::vector<T> apply_weights_, sweep_weights_;  // rows by lane: x, y, z
};

}  // namespace prdp::kernels
