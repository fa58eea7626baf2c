#pragma once
#include <array>
#include <functional>
#include <utility>

#include "prdp/kernels/kernel.h"
#include "prdp/kernels/packed_stencil.h"

namespace prdp::kernels {

/// One stencil with its own coefficients at every point, on each channel of a sample.
template <class T>
class Stencil final : public Kernel<T> {
  using Base = Kernel<T>;

 public:
  using Base::layout;

  /// What the rows were made of; `transposed` says which way round.
  struct Source {
    std::function<FactorKey()> key;                    // of the matrix that is not transposed
    std::function<std::optional<StencilFields<T>>()> as_fields;  // its coefficients; nothing if neighbours lie far away
    bool transposed = false;
  };

  Stencil(std::shared_ptr<const PackedStencil<T>> rows, int64_t channels, T factor, Source source = {})
      : Base(Layout<T>::of_fields(channels, rows->rows(), rows->grid().shape[2]), factor),
        rows_(std::move(rows)),
        coefficients_(*rows_),
        source_(std::move(source)) {}

  int64_t channels() const { return layout().planes; }
  /// Of one channel.
  const PackedStencil<T>& coefficients() const { return coefficients_; }
  double norm() const override { return coefficients_.norm(); }
  bool is_surely_definite() const override { return !this->null_space() && coefficients_.is_surely_definite(); }
  bool has_definite_factors(const T* x, const T* b) const override {
    if (!is_surely_definite() || coefficients_.spread() >= kWidestRowsOfFactors) return false;
    for (int64_t at = 0; at < this->length(); at += layout().plane)
      if (!coefficients_.sums_agree(x + at, b + at)) return false;
    return true;
  }

  void apply(const T* v, T* out) const override {
    share_rows::for_each(parts(), [&](int64_t p) {
      const auto [lines, at] = part(p);
      coefficients_.apply(lines, v + at, out + at, nullptr);
    });
  }
  std::array<T, 2> apply_with_dots(const T* v, T* out) const override {
    return sums_over<T, 2>(parts(), [&](int64_t p, T* dots) {
      const auto [lines, at] = part(p);
      coefficients_.apply(lines, v + at, out + at, dots);
    });
  }

  bool has_zero_diagonal() const override {
    for (int64_t r = 0; r < layout().rows; ++r) {
      const T* d = coefficients_.coefficient(r, 0);
      if (std::find(d, d + layout().nx, T(0)) != d + layout().nx) return true;
    }
    return false;
  }
  void divide_by_diagonal(const T* b, T* c) const override {
    const int64_t row = layout().row;
    share_rows::for_each(parts(), [&](int64_t p) {
      const auto [lines, at] = part(p);
      for (int64_t r = lines.begin; r < lines.end; ++r) {
        const T* d = coefficients_.coefficient(r, 0);
        for (int64_t i = 0; i < row; ++i) c[at + r * row + i] = b[at + r * row + i] / d[i];
      }
    });
  }
  void jacobi_sweeps(const T* c, T*& x, T*& y, int64_t n, const T*) const override {
    for (; n > 0; --n, std::swap(x, y))
      share_rows::for_each(parts(), [&](int64_t p) {
        const auto [lines, at] = part(p);
        coefficients_.sweep(lines, c + at, x + at, y + at, nullptr);
      });
  }
  T jacobi_sweep(const T* c, const T* x, T* y, const T*) const override {
    return sums_over<T, 1>(parts(), [&](int64_t p, T* squares) {
      const auto [lines, at] = part(p);
      coefficients_.sweep(lines, c + at, x + at, y + at, squares);
    })[0];
  }
  void smooth(const T* b, const T* x, T* y, T p, T q) const override {
    share_rows::for_each(parts(), [&](int64_t i) {
      const auto [lines, at] = part(i);
      coefficients_.smooth(lines, b + at, x + at, y + at, p, q);
    });
  }
  void residual(const T* b, const T* x, T* r) const override {
    share_rows::for_each(parts(), [&](int64_t i) {
      const auto [lines, at] = part(i);
      coefficients_.residual(lines, b + at, x + at, r + at);
    });
  }
  std::shared_ptr<const Factors<T>> factorise() const override;
  void leave_source() override {
    source_.key = [key = source_.key()] { return key; };
    source_.as_fields = nullptr;
  }
  int64_t bytes() const override {
    return Base::bytes() + layout().rows * coefficients_.stride() * static_cast<int64_t>(sizeof(T));
  }
  std::optional<GridOperator<T>> grid_operator() const override {
    if (!source_.as_fields) return std::nullopt;
    return GridOperator<T>{source_.as_fields, source_.key(), source_.transposed};
  }

 private:
  /// A sample in parts: blocks of rows, of one channel each.
  int64_t rows_each() const { return std::max<int64_t>(kBlock / layout().row, 1); }
  int64_t of_channel() const { return (layout().rows + rows_each() - 1) / rows_each(); }
  int64_t parts() const { return channels() * of_channel(); }
  /// The rows of part p, and where its channel begins.
  std::pair<Lines, int64_t> part(int64_t p) const {
    const int64_t first = p % of_channel() * rows_each();
    return {{first, std::min(first + rows_each(), layout().rows)}, p / of_channel() * layout().plane};
  }

  std::shared_ptr<const PackedStencil<T>> rows_;
  const PackedStencil<T>& coefficients_;
  Source source_;
};

}  // namespace prdp::kernels
