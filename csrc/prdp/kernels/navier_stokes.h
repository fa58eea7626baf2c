#pragma once
#include <limits>
#include <optional>

#include "prdp/kernels/field_rows.h"
#include "prdp/kernels/upwind_rows.h"

namespace prdp::kernels {

/// [[C1, 0, G1], [0, C2, G2], [D1, D2, 0]] with C_i = I/dt + Γ_i - ν L on one sample of a staggered
/// grid: u1 on the left faces, u2 on the bottom faces, p in the centres of the cells. A constant
/// pressure is in the null space of A and Aᵀ. It has coefficients itself if all samples
/// share the velocity; otherwise only sample(s) has them.
template <class T>
class NavierStokes : public FieldRows<T> {
  using Base = FieldRows<T>;
  using Base::field, Base::row_, Base::loops_;

 public:
  explicit NavierStokes(const UpwindParameters<T>& p)
      : Base(3, p.ny, p.nx),
        parameters_(p),
        inverse_dx_(inverse_spacing(p.nx, p.length_x, p.transposed)),
        inverse_dy_(inverse_spacing(p.ny, p.length_y, p.transposed)) {
    if (!is_shared() || !p.is_finite(2)) return;
    const auto pattern = p.pattern(2);
    const UpwindTerms terms{1.0 / p.dt, 1.0, p.nu, p.transposed, p.length_y, p.length_x};
    const auto u1 = [&p](int64_t j) { return p.winds + (j + p.ny) % p.ny * p.nx; };
    const auto u2 = [&](int64_t j) { return u1(j) + p.ny * p.nx; };
    const auto at_point = [](const T* wind) { return WindRow<T>{wind, wind, wind}; };
    velocity_[0].emplace(upwind_rows<T>(pattern, terms, [&](int axis, int64_t j, T* mean) {
      if (axis == 0) return at_point(u1(j));
      for (int64_t i = 0; i < p.nx; ++i) mean[i + 1] = u2(j)[i] + u2(j + 1)[i];
      mean[0] = mean[p.nx];
      return at_point(finish_mean(mean));
    }));
    velocity_[1].emplace(upwind_rows<T>(pattern, terms, [&](int axis, int64_t j, T* mean) {
      if (axis == 1) return at_point(u2(j));
      for (int64_t i = 0; i < p.nx; ++i) mean[i] = u1(j - 1)[i] + u1(j)[i];
      mean[p.nx] = mean[0];
      return at_point(finish_mean(mean));
    }));
    make_weights();
  }

  bool is_shared() const { return parameters_.is_shared(); }
  bool operator_is_finite() const { return !is_shared() || velocity_[0].has_value(); }
  NavierStokes sample(int64_t s) const { return NavierStokes(parameters_.sample(s)); }
  double norm() const {
    if (!velocity_[0]) return std::numeric_limits<double>::quiet_NaN();
    const double x = std::abs(inverse_dx_), y = std::abs(inverse_dy_);
    return std::max({velocity_[0]->norm() + 2 * x, velocity_[1]->norm() + 2 * y, 2 * (x + y)});
  }
  bool has_zero_diagonal() const { return true; }  // the pressure's: what divides by it is never called
  void divide_by_diagonal(const T*, T*) const {}
  void jacobi_sweeps(const T*, T*&, T*&, int64_t) const {}
  T jacobi_sweep(const T*, const T*, T*) const { return T(0); }

  /// out = A v
  void apply(const T* v, T* out) const {
    loops_.apply_staggered({{velocity_[0]->neighbours(), velocity_[1]->neighbours()}, weights_.data()}, v, out);
  }
  /// Takes the mean off the pressure.
  void project(T* v) const {
    const T mean = pressure_mean(v);
    for (int64_t j = 0; j < ny(); ++j) loops_.axpy(-mean, weight(kOne), pressure(v, j), row_);
  }
  /// Norm of what project() takes off: how far a right-hand side v is from having a solution.
  T inconsistency(const T* v) const { return std::abs(pressure_mean(v)) * std::sqrt(static_cast<T>(ny() * nx())); }

  /// Calls body(row, column, value) for the entries of A as applied; those that coincide one by one.
  template <class Body>
  void for_each_entry(const Body& body) const {
    const int64_t n = ny() * nx();
    for (int64_t c = 0; c < 2; ++c)
      velocity_[c]->for_each_entry([&](int64_t i, int64_t j, T a) { body(c * n + i, c * n + j, a); });
    // Backward differences of the pressure; D = -Gᵀ.
    const auto gradient = [&](int64_t u, int64_t p, T value) {
      body(u, 2 * n + p, value);
      body(2 * n + p, u, -value);
    };
    for (int64_t j = 0; j < ny(); ++j)
      for (int64_t i = 0; i < nx(); ++i) {
        const int64_t at = j * nx() + i;
        gradient(at, at, inverse_dx_);
        gradient(at, i > 0 ? at - 1 : at + nx() - 1, -inverse_dx_);
        gradient(n + at, at, inverse_dy_);
        gradient(n + at, j > 0 ? at - nx() : at + n - nx(), -inverse_dy_);
      }
  }

 private:
  enum Weight { kX, kXLower, kXUpper, kY, kOne, kWeights };  // the first four: StaggeredStencil

  int64_t nx() const { return parameters_.nx; }
  int64_t ny() const { return parameters_.ny; }

  /// Along an axis of one point all differences vanish.
  static T inverse_spacing(int64_t n, double length, bool transposed) {
    const double inverse = static_cast<double>(n) / length;
    return n == 1 ? T(0) : static_cast<T>(transposed ? -inverse : inverse);
  }
  /// From sums over two rows to means over four points.
  const T* finish_mean(T* sum) const {
    for (int64_t i = 0; i < nx(); ++i) sum[i] = T(0.25) * (sum[i] + sum[i + 1]);
    return sum;
  }
  void make_weights() {
    weights_.assign(kWeights * row_, T(0));
    for (int64_t i = 0; i < nx(); ++i) {
      weights_[kX * row_ + i] = inverse_dx_;
      weights_[kXLower * row_ + i] = i > 0 ? inverse_dx_ : T(0);
      weights_[kXUpper * row_ + i] = i + 1 < nx() ? inverse_dx_ : T(0);
      weights_[kY * row_ + i] = inverse_dy_;
      weights_[kOne * row_ + i] = T(1);
    }
  }
  const T* weight(Weight which) const { return weights_.data() + which * row_; }
  template <class Pointer>
  Pointer pressure(Pointer v, int64_t j) const {
    return v + 2 * field() + j * row_;
  }
  T pressure_mean(const T* v) const {
    double sum = 0;
    for (int64_t j = 0; j < ny(); ++j) sum += static_cast<double>(loops_.dot(pressure(v, j), weight(kOne), row_));
    return static_cast<T>(sum / static_cast<double>(ny() * nx()));
  }

  UpwindParameters<T> parameters_;
  T inverse_dx_, inverse_dy_;  // negative in the transpose
  std::optional<StencilRows<T>> velocity_[2];
  std::vector<T> weights_;  // rows of the padded length
};

}  // namespace prdp::kernels
