#pragma once
#include <algorithm>
#include <utility>

#include "prdp/kernels/kernel.h"
#include "prdp/kernels/upwind_rows.h"

namespace prdp::kernels {

/// [[C1, 0, G1], [0, C2, G2], [D1, D2, 0]] with C_i = I/dt + Γ_i - ν L on one sample of a staggered
/// grid: u1 on the left faces, u2 on the bottom faces, p in the centres of the cells. A constant
/// pressure is in the null space of A and Aᵀ.
template <class T>
class NavierStokes final : public Kernel<T> {
  using Base = Kernel<T>;

 public:
  using Base::layout;

  /// The winds must be finite.
  explicit NavierStokes(const UpwindParameters<T>& p) : NavierStokes(p, scale_of(p)) {}

  double norm() const override {
    const double x = std::abs(inverse_dx_), y = std::abs(inverse_dy_);
    return std::max({velocity_[0]->norm() + 2 * x, velocity_[1]->norm() + 2 * y, 2 * (x + y)});
  }
  bool has_zero_diagonal() const override { return true; }  // the pressure's: what divides by it is never called
  void divide_by_diagonal(const T*, T*) const override {}
  void jacobi_sweeps(const T*, T*&, T*&, int64_t, const T*) const override {}
  T jacobi_sweep(const T*, const T*, T*, const T*) const override { return T(0); }

  void apply(const T* v, T* out) const override {
    const StaggeredStencil<T> a{{velocity_[0]->neighbours(), velocity_[1]->neighbours()}, weights_.data()};
    for_each_run_of_rows(layout().rows, layout().row,
                         [&](int64_t begin, int64_t end) { loops<T>().apply_staggered(a, {begin, end}, v, out); });
  }
  std::shared_ptr<const Factors<T>> factorise() const override;
  std::unique_ptr<Preconditioner<T>> multigrid(const Kernel<T>* transpose, int64_t smoothing) const override;

  /// Calls body(row, column, value) for the entries of A as applied; those that coincide one by one.
  template <class Body>
  void for_each_entry(const Body& body) const {
    const int64_t n = ny() * nx();
    for (int64_t c = 0; c < 2; ++c)
      velocity_[c]->for_each_entry([&](int64_t i, int64_t j, double a) { body(c * n + i, c * n + j, a); });
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

  /// Tells the matrix from others, the same for its transpose.
  FactorKey key() const { return parameters_.key(2); }
  bool transposed() const { return parameters_.transposed; }
  const UpwindParameters<T>& parameters() const { return parameters_; }
  /// C1 or C2, times factor().
  const std::shared_ptr<const PackedStencil<T>>& velocity(int64_t channel) const { return velocity_[channel]; }

 private:
  enum Weight { kX, kXLower, kXUpper, kY, kWeights };  // of StaggeredStencil

  NavierStokes(const UpwindParameters<T>& p, double factor)
      : Base(Layout<T>::of_fields(3, p.ny, p.nx), static_cast<T>(factor)),
        parameters_(p),
        inverse_dx_(inverse_spacing(p.nx, p.length_x, factor)),
        inverse_dy_(inverse_spacing(p.ny, p.length_y, factor)),
        velocity_{std::make_shared<PackedStencil<T>>(c1(p, factor)), std::make_shared<PackedStencil<T>>(c2(p, factor))},
        weights_(kWeights * layout().row, T(0)) {
    for (int64_t i = 0; i < nx(); ++i) {
      weight(kX)[i] = inverse_dx_;
      weight(kXLower)[i] = i > 0 ? inverse_dx_ : T(0);
      weight(kXUpper)[i] = i + 1 < nx() ? inverse_dx_ : T(0);
      weight(kY)[i] = inverse_dy_;
    }
    const std::vector<NullVector> constant{
        {0, std::vector<double>(ny() * nx(), 1.0 / std::sqrt(static_cast<double>(ny() * nx())))}};
    const NullSpace<T> pressure(layout(), 2, 1, constant);
    Base::set_null_spaces(pressure, pressure);
  }
  static double scale_of(const UpwindParameters<T>& p) {
    const double gradient = std::max(static_cast<double>(p.nx) / p.length_x, static_cast<double>(p.ny) / p.length_y);
    return scale_of_operator(std::max(p.magnitude(2, 1.0 / p.dt, 1.0, p.nu), gradient));
  }

  /// u1, or u2, at row j of the grid, which is periodic.
  static const T* wind(const UpwindParameters<T>& p, int64_t channel, int64_t j) {
    return p.winds + (channel * p.ny + (j + p.ny) % p.ny) * p.nx;
  }
  static UpwindTerms terms(const UpwindParameters<T>& p, double factor) {
    return {factor / p.dt, factor, factor * p.nu, p.transposed, p.length_y, p.length_x};
  }
  static WindRow<T> at_point(const T* wind) { return {wind, wind, wind}; }
  /// From sums over two rows to means over four points.
  static const T* finish_mean(T* sum, int64_t nx) {
    for (int64_t i = 0; i < nx; ++i) sum[i] = T(0.25) * (sum[i] + sum[i + 1]);
    return sum;
  }
  static PackedStencil<T> c1(const UpwindParameters<T>& p, double factor) {
    return upwind_rows<T>(p.pattern, terms(p, factor), [&](int axis, int64_t j, T* mean) {
      if (axis == 0) return at_point(wind(p, 0, j));
      for (int64_t i = 0; i < p.nx; ++i) mean[i + 1] = wind(p, 1, j)[i] + wind(p, 1, j + 1)[i];
      mean[0] = mean[p.nx];
      return at_point(finish_mean(mean, p.nx));
    });
  }
  static PackedStencil<T> c2(const UpwindParameters<T>& p, double factor) {
    return upwind_rows<T>(p.pattern, terms(p, factor), [&](int axis, int64_t j, T* mean) {
      if (axis == 1) return at_point(wind(p, 1, j));
      for (int64_t i = 0; i < p.nx; ++i) mean[i] = wind(p, 0, j - 1)[i] + wind(p, 0, j)[i];
      mean[p.nx] = mean[0];
      return at_point(finish_mean(mean, p.nx));
    });
  }

  int64_t nx() const { return parameters_.nx; }
  int64_t ny() const { return parameters_.ny; }
  /// Along an axis of one point all differences vanish.
  T inverse_spacing(int64_t n, double length, double factor) const {
    const double inverse = static_cast<double>(n) / length * factor;
    return n == 1 ? T(0) : static_cast<T>(parameters_.transposed ? -inverse : inverse);
  }
  T* weight(Weight which) { return weights_.data() + which * layout().row; }

  UpwindParameters<T> parameters_;
  T inverse_dx_, inverse_dy_;  // negative in the transpose
  std::shared_ptr<const PackedStencil<T>> velocity_[2];
  std::vector<T> weights_;  // rows of the padded length
};

/// Null where a wind is not finite.
template <class T>
std::unique_ptr<Kernel<T>> navier_stokes(const UpwindParameters<T>& p) {
  return std::isfinite(p.largest_wind(2)) ? std::make_unique<NavierStokes<T>>(p) : nullptr;
}

}  // namespace prdp::kernels
