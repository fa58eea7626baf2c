#pragma once
#include "prdp/kernels/laplacian_parameters.h"
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
        weights_(8 * row_, T(0)) {
    // Weights of the padding lanes are zero, so padding stays zero in every product. The second
    // half is the Jacobi sweep's, -off/centre.
    for (int64_t i = 0; i < nx_; ++i) {
      weights_[i] = centre_;
      for (int d = 0; d < Dim; ++d) {
        weights_[(d + 1) * row_ + i] = static_cast<T>(p.off[Dim - 1 - d]);
        weights_[(d + 5) * row_ + i] = static_cast<T>(-p.off[Dim - 1 - d] / p.centre);
      }
    }
    norm_ = std::abs(p.centre);
    for (int d = 0; d < Dim; ++d) norm_ += 2.0 * std::abs(p.off[d]);
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
    for_each_row([&](int64_t at, int64_t from) {
      for (int64_t i = 0; i < nx_; ++i) dst[at + i] = scale * src[from + i];
    });
  }
  void store(const T* src, T scale, T* dst) const {
    for_each_row([&](int64_t at, int64_t to) {
      for (int64_t i = 0; i < nx_; ++i) dst[to + i] = scale * src[at + i];
    });
  }

  /// out = A v
  void apply(const T* __restrict v, T* __restrict out) const {
    const T* w = weights_.data();
    for_each_row([&](int64_t at, int64_t) {
      for (int64_t i = 0; i < row_; i += kLanes<T>)
        for (int64_t l = i; l < i + kLanes<T>; ++l)
          out[at + l] = w[l] * v[at + l] + neighbours(w, v, at, l);
    });
  }

  /// c = D⁻¹ b
  void divide_by_diagonal(const T* __restrict b, T* __restrict c) const {
    for (int64_t i = 0; i < length(); ++i) c[i] = b[i] / centre_;
  }

  /// One Jacobi sweep y = x + D⁻¹(b - A x) with c = D⁻¹ b. Returns ‖b - A x‖² if asked for.
  template <bool WithResidual>
  T jacobi_sweep(const T* __restrict c, const T* __restrict x, T* __restrict y) const {
    const T* w = weights_.data() + 4 * row_;
    T part[kLanes<T>] = {};
    for_each_row([&](int64_t at, int64_t) {
      for (int64_t i = 0; i < row_; i += kLanes<T>)
        for (int64_t l = 0; l < kLanes<T>; ++l) {
          const T next = c[at + i + l] + neighbours(w, x, at, i + l);
          if constexpr (WithResidual) {
            const T change = next - x[at + i + l];
            part[l] += change * change;
          }
          y[at + i + l] = next;
        }
    });
    return WithResidual ? centre_ * centre_ * pairwise_sum(part) : T(0);
  }

 private:
  /// Calls body(start of the row in the padded layout, start in the contiguous one).
  template <class Body>
  void for_each_row(const Body& body) const {
    for (int64_t z = 0; z < nz_; ++z)
      for (int64_t y = 0; y < ny_; ++y) body(z * plane_ + y * row_, (z * ny_ + y) * nx_);
  }

  /// Weighted sum of the 2·Dim neighbours of the point `l` of the row that starts at `at`.
  T neighbours(const T* w, const T* v, int64_t at, int64_t l) const {
    const int64_t i = at + l;
    T sum = w[row_ + l] * (v[i - 1] + v[i + 1]);
    if constexpr (Dim > 1) sum += w[2 * row_ + l] * (v[i - row_] + v[i + row_]);
    if constexpr (Dim > 2) sum += w[3 * row_ + l] * (v[i - plane_] + v[i + plane_]);
    return sum;
  }

  LaplacianParameters parameters_;
  int64_t nx_, ny_, nz_, row_, plane_;
  T centre_;
  double norm_;
  std::vector<T> weights_;  // by lane: centre, x, y, z; unused, x, y, z over -centre
};

}  // namespace prdp::kernels
