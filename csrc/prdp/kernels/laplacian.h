#pragma once
#include <cmath>

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
        apply_weights_((Dim + 1) * row_, T(0)),
        sweep_weights_(Dim * row_, T(0)) {
    norm_ = std::abs(p.centre);
    for (int64_t i = 0; i < nx_; ++i) apply_weights_[i] = centre_;
    for (int d = 0; d < Dim; ++d) {
      const double off = p.off[Dim - 1 - d];
      norm_ += 2.0 * std::abs(off);
      for (int64_t i = 0; i < nx_; ++i) {
        apply_weights_[(d + 1) * row_ + i] = static_cast<T>(off);
        sweep_weights_[d * row_ + i] = static_cast<T>(-off / p.centre);
      }
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
    for (int64_t r = 0; r < nz_ * ny_; ++r)
      for (int64_t i = 0; i < nx_; ++i) dst[padded(r) + i] = scale * src[r * nx_ + i];
  }
  void store(const T* src, T scale, T* dst) const {
    for (int64_t r = 0; r < nz_ * ny_; ++r)
      for (int64_t i = 0; i < nx_; ++i) dst[r * nx_ + i] = scale * src[padded(r) + i];
  }

  /// out = A v
  void apply(const T* v, T* out) const { loops_.apply[Dim - 1](stencil(apply_weights_), v, out); }

  /// c = D⁻¹ b
  void divide_by_diagonal(const T* b, T* c) const {
    for (int64_t i = 0; i < length(); ++i) c[i] = b[i] / centre_;
  }

  /// One Jacobi sweep y = x + D⁻¹(b - A x) with c = D⁻¹ b. Returns ‖b - A x‖² if asked for.
  template <bool WithResidual>
  T jacobi_sweep(const T* c, const T* x, T* y) const {
    const auto a = stencil(sweep_weights_);
    if constexpr (WithResidual) return centre_ * centre_ * loops_.sweep_and_measure[Dim - 1](a, c, x, y);
    loops_.sweep[Dim - 1](a, c, x, y);
    return T(0);
  }

 private:
  /// Where row r (counted over all planes) starts in the padded layout.
  int64_t padded(int64_t r) const { return r / ny_ * plane_ + r % ny_ * row_; }
  PaddedStencil<T> stencil(const std::vector<T>& weights) const {
    return {ny_, nz_, row_, plane_, weights.data()};
  }

  const Loops<T>& loops_ = kernels::loops<T>();
  LaplacianParameters parameters_;
  int64_t nx_, ny_, nz_, row_, plane_;
  T centre_;
  double norm_;
  std::vector<T> apply_weights_, sweep_weights_;  // rows by lane: (centre,) x, y, z
};

}  // namespace prdp::kernels
