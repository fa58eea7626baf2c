#pragma once
#include <limits>
#include <optional>

#include "prdp/kernels/upwind_stencil.h"

namespace prdp::kernels {

/// I + dt Γ(w) - ν dt L on each channel of one sample, with the winds averaged to the faces. It knows
/// its coefficients where all samples share the winds, else those of sample(s) do.
template <class T, int Dim>
class Burgers : public PeriodicBase<T, Dim, Burgers<T, Dim>> {
  using Base = PeriodicBase<T, Dim, Burgers<T, Dim>>;

 public:
  explicit Burgers(const UpwindParameters<T>& p) : Base(p) {
    if (!this->is_shared()) return;
    const auto wind = [&p](int64_t channel, int64_t j) { return p.winds + (channel * p.ny + j) * p.nx; };
    const auto winds = [&](int axis, int64_t j, T* scratch) -> WindRow<T> {
      if (axis == 1)
        return {wind(1, j > 0 ? j - 1 : p.ny - 1), wind(1, j), wind(1, j + 1 < p.ny ? j + 1 : 0)};
      const T* w = wind(0, j);
      scratch[0] = w[p.nx - 1];
      std::copy(w, w + p.nx, scratch + 1);
      scratch[p.nx + 1] = w[0];
      return {scratch, scratch + 1, scratch + 2};
    };
    const typename Stencil::Terms terms{1.0, p.dt, p.nu * p.dt, p.transposed, p.length_y, p.length_x};
    stencil_.emplace(p.ny, p.nx, terms, winds);
  }

  Burgers sample(int64_t s) const { return Burgers(this->parameters_.sample(s)); }
  double norm() const {
    return this->finite_ ? stencil_->norm() : std::numeric_limits<double>::quiet_NaN();
  }
  bool has_zero_diagonal() const { return false; }  // 1 and more
  const T* diagonal(int64_t r) const { return stencil_->diagonal(r % this->ny()); }

  /// out = A v
  void apply(const T* v, T* out) const {
    for (int64_t at = 0; at < this->length(); at += this->field())
      this->loops_.apply_periodic[Dim - 1](stencil_->stencil(), v + at, out + at);
  }
  /// Calls body(row, column, value) for the entries of the block that all channels share.
  template <class Body>
  void for_each_entry(const Body& body) const {
    stencil_->for_each_entry(body);
  }

 private:
  using Stencil = UpwindStencil<T, Dim>;
  std::optional<Stencil> stencil_;
};

}  // namespace prdp::kernels
