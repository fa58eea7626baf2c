#pragma once
#include <functional>
#include <limits>
#include <optional>

#include "prdp/kernels/field_rows.h"
#include "prdp/kernels/stencil_rows.h"

namespace prdp::kernels {

/// One stencil with its own coefficients at every point, on each channel of a sample. It has coefficients itself if all
/// samples share them; otherwise only sample(s) has them.
template <class T>
class Stencil : public FieldRows<T> {
 public:
  /// The coefficients of a sample; none where they, or what they are made of, are not finite.
  using Assemble = std::function<std::optional<StencilRows<T>>(int64_t sample)>;

  Stencil(const StencilGrid& grid, int64_t channels, bool is_shared, Assemble assemble)
      : FieldRows<T>(channels, grid.shape[0] * grid.shape[1], grid.shape[2]),
        grid_(grid),
        is_shared_(is_shared),
        assemble_(std::move(assemble)) {
    if (is_shared) coefficients_ = assemble_(0);
  }
  Stencil sample(int64_t s) const {
    return {grid_, this->fields_, true, [this, s](int64_t) { return assemble_(s); }};
  }
  bool is_shared() const { return is_shared_; }
  bool operator_is_finite() const { return !is_shared_ || coefficients_.has_value(); }
  double norm() const { return coefficients_ ? coefficients_->norm() : std::numeric_limits<double>::quiet_NaN(); }
  int64_t channels() const { return this->fields_; }
  /// Of one channel.
  const StencilRows<T>& coefficients() const { return *coefficients_; }

  /// out = A v
  void apply(const T* v, T* out) const { apply_to_channels(v, out, nullptr); }
  /// The same; returns v·out and ‖out‖².
  std::array<T, 2> apply_with_dots(const T* v, T* out) const {
    std::array<T, 2> dots{};
    apply_to_channels(v, out, dots.data());
    return dots;
  }

  bool has_zero_diagonal() const {
    for (int64_t r = 0; r < this->rows_; ++r) {
      const T* d = diagonal(r);
      if (std::find(d, d + this->nx_, T(0)) != d + this->nx_) return true;
    }
    return false;
  }
  /// c = D⁻¹ b
  void divide_by_diagonal(const T* b, T* c) const {
    for (int64_t r = 0; r < this->fields_ * this->rows_; ++r) {
      const T* d = diagonal(r % this->rows_);
      for (int64_t i = 0; i < this->row_; ++i) c[r * this->row_ + i] = b[r * this->row_ + i] / d[i];
    }
  }
  /// n Jacobi sweeps x ← x + D⁻¹(b - A x) with c = D⁻¹ b; y is memory that they use.
  void jacobi_sweeps(const T* c, T*& x, T*& y, int64_t n) const {
    for (; n > 0; --n, std::swap(x, y)) sweep_channels(c, x, y, nullptr);
  }
  /// One of them, from x to y; returns ‖b - A x‖².
  T jacobi_sweep(const T* c, const T* x, T* y) const {
    T squares = 0;
    sweep_channels(c, x, y, &squares);
    return squares;
  }

 private:
  const T* diagonal(int64_t r) const { return coefficients_->coefficient(r, 0); }
  void apply_to_channels(const T* v, T* out, T* dots) const {
    for (int64_t at = 0; at < this->length(); at += this->field()) coefficients_->apply(v + at, out + at, dots);
  }
  void sweep_channels(const T* c, const T* x, T* y, T* squares) const {
    for (int64_t at = 0; at < this->length(); at += this->field())
      coefficients_->sweep(c + at, x + at, y + at, squares);
  }

  StencilGrid grid_;
  bool is_shared_;
  Assemble assemble_;
  std::optional<StencilRows<T>> coefficients_;
};

}  // namespace prdp::kernels
