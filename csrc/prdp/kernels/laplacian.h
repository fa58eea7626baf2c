#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numbers>
#include <utility>
#include <vector>

#include "prdp/kernels/kernel.h"

namespace prdp::kernels {

/// A v = centre·v + Σ_d off_d (v_{i-1} + v_{i+1} along d), zero outside the grid. The axes are in
/// tensor order and fill the front of the arrays: (nx), (ny, nx) or (nz, ny, nx).
struct LaplacianParameters {
  int64_t dim = 0;
  std::array<int64_t, 3> shape{1, 1, 1};
  double centre = 0.0;
  std::array<double, 3> off{};
};

/// The spectral radius of I - D⁻¹A. Its eigenvalues come in pairs ±μ.
inline double jacobi_radius(const LaplacianParameters& a) {
  double sum = 0;
  for (int64_t d = 0; d < a.dim; ++d)
    sum += 2 * std::abs(a.off[d]) * std::cos(std::numbers::pi / static_cast<double>(a.shape[d] + 1));
  return sum / std::abs(a.centre);
}

/// The Laplacian-type stencil on one sample. A sample is stored in its native order with at least one zero between
/// rows, planes one zero row apart, and a zero halo in front and behind, so that neighbours outside the grid read zero
/// without a branch.
template <class T, int Dim>
class Laplacian final : public Kernel<T> {
  using Base = Kernel<T>;

 public:
  using Base::layout, Base::length;

  explicit Laplacian(const LaplacianParameters& given) : Laplacian(given, scale_of(given)) {}

  double norm() const override { return norm_; }
  bool has_zero_diagonal() const override { return centre_ == T(0); }
  void divide_by_diagonal(const T* b, T* c) const override { Base::vectors_.scale(T(1) / centre_, b, c, length()); }

  void apply(const T* v, T* out) const override { apply_with_dots(v, out); }
  std::array<T, 2> apply_with_dots(const T* v, T* out) const override {
    return sums_over<T, 2>(parts(), [&](int64_t p, T* dots) {
      const auto [a, at] = part(p, apply_weights_);
      loops_.apply[Dim - 1](a, v + at, out + at, dots);
    });
  }

  void jacobi_sweeps(const T* c, T*& x, T*& y, int64_t n, const T* omega) const override {
    if (parts() == 1) {
      if (loops_.sweeps[Dim - 1](stencil(sweep_weights_), c, x, y, n, omega) != x) std::swap(x, y);
      return;
    }
    for (int64_t s = 0; s < n; ++s, std::swap(x, y)) jacobi_sweep(c, x, y, omega ? omega + s : nullptr);
  }
  T jacobi_sweep(const T* c, const T* x, T* y, const T* omega) const override {
    const auto change2 = sums_over<T, 1>(parts(), [&](int64_t p, T* sum) {
      const auto [a, at] = part(p, sweep_weights_);
      *sum = loops_.sweep_and_measure[Dim - 1](a, c + at, x + at, y + at, omega);
    });
    return centre_ * centre_ * change2[0];
  }
  std::optional<double> radius() const override { return radius_; }
  /// By the condition number of A, (1 + ρ)/(1 - ρ).
  bool has_definite_factors(const T* /*x*/, const T* /*b*/) const override {
    return 1.0 + radius_ < kWidestRowsOfFactors * (1.0 - radius_);
  }
  void smooth(const T* b, const T* x, T* y, T p, T q) const override {
    share_rows::for_each(parts(), [&](int64_t i) {
      const auto [a, at] = part(i, apply_weights_);
      loops_.smooth[Dim - 1](a, b + at, x + at, y + at, p, q, T(1) / centre_);
    });
  }
  void residual(const T* b, const T* x, T* r) const override {
    share_rows::for_each(parts(), [&](int64_t i) {
      const auto [a, at] = part(i, apply_weights_);
      loops_.residual[Dim - 1](a, b + at, x + at, r + at);
    });
  }
  std::optional<GridOperator<T>> grid_operator() const override;
  std::shared_ptr<const Factors<T>> factorise() const override;

 private:
  Laplacian(LaplacianParameters p, double factor) : Base(layout_of(p), static_cast<T>(factor)), parameters_(p) {
    parameters_.centre *= factor;
    for (auto& off : parameters_.off) off *= factor;
    centre_ = static_cast<T>(parameters_.centre);
    norm_ = std::abs(parameters_.centre);
    radius_ = jacobi_radius(parameters_);
    const int64_t row = layout().row, nx = layout().nx;
    apply_weights_.assign(Dim * row, T(0));
    sweep_weights_.assign(Dim * row, T(0));
    for (int d = 0; d < Dim; ++d) {
      const double off = parameters_.off[Dim - 1 - d];
      norm_ += 2.0 * std::abs(off);
      std::fill_n(apply_weights_.begin() + d * row, nx, static_cast<T>(off));
      std::fill_n(sweep_weights_.begin() + d * row, nx, static_cast<T>(-off / parameters_.centre));
    }
  }

  /// In double, as the centre may lie outside the range of T.
  static double scale_of(const LaplacianParameters& p) { return scale_of_operator(std::abs(p.centre)); }
  static Layout<T> layout_of(const LaplacianParameters& p) {
    const int64_t nx = p.shape[Dim - 1], ny = Dim > 1 ? p.shape[Dim - 2] : 1, nz = Dim > 2 ? p.shape[Dim - 3] : 1;
    const int64_t row = round_up_to_lanes<T>(nx + 1), plane = (Dim > 2 ? ny + 1 : ny) * row;
    return {nz, ny, nx, row, plane, Dim == 1 ? kLanes<T> : Dim == 2 ? row : plane};
  }

  ConstantStencil<T> stencil(const std::vector<T>& weights) const {
    return {layout().rows, layout().planes, layout().row, layout().plane, centre_, weights.data()};
  }
  /// A large sample in parts for several threads: values of the only row, rows of the only plane, or planes.
  int64_t size_of_part() const {
    if constexpr (Dim == 1) return kBlock;
    return std::max<int64_t>(kBlock / (Dim == 2 ? layout().row : layout().plane), 1);
  }
  int64_t size_in_all() const { return Dim == 1 ? layout().row : Dim == 2 ? layout().rows : layout().planes; }
  int64_t parts() const { return length() <= kBlock ? 1 : std::max<int64_t>(size_in_all() / size_of_part(), 1); }
  /// Part p, and where it begins.
  std::pair<ConstantStencil<T>, int64_t> part(int64_t p, const std::vector<T>& weights) const {
    auto a = stencil(weights);
    if (parts() == 1) return {a, 0};
    const int64_t first = p * size_of_part(), count = p + 1 < parts() ? size_of_part() : size_in_all() - first;
    if constexpr (Dim == 1) {
      a.row = count;
      a.weights += first;
      return {a, first};
    }
    (Dim == 2 ? a.ny : a.nz) = count;
    return {a, first * (Dim == 2 ? layout().row : layout().plane)};
  }

  const Loops<T>& loops_ = loops<T>();
  LaplacianParameters parameters_;  // of factor()·A
  T centre_;
  double norm_, radius_;
  std::vector<T> apply_weights_, sweep_weights_;  // rows by lane: x, y, z
};

template <class T, int Dim>
std::optional<GridOperator<T>> Laplacian<T, Dim>::grid_operator() const {
  const auto make = [p = parameters_] {
    StencilFields<T> a({Dim, {1, 1, 1}, {false, false, false}});
    for (int d = 0; d < Dim; ++d) a.grid.shape[3 - Dim + d] = p.shape[d];
    const auto add = [&](const Offset& o, double value) {
      std::fill_n(a.add(StencilFields<T>::place(o)), a.points(), static_cast<T>(value));
    };
    add({{0, 0, 0}}, p.centre);
    for (int d = 0; d < Dim; ++d)
      for (const int64_t side : {-1, 1}) {
        Offset o{{0, 0, 0}};
        o.along[3 - Dim + d] = side;
        add(o, p.off[d]);
      }
    return std::optional(std::move(a));
  };
  FactorKeyMaker key;
  key.add(parameters_.dim).add(parameters_.shape.data(), 3).add(parameters_.centre).add(parameters_.off.data(), 3);
  return GridOperator<T>{make, key.key(), false};
}

/// Of all samples of a batch, or one for each; null where it is not finite.
template <class T>
KernelBatch<T> laplacian(std::vector<LaplacianParameters> of_samples) {
  const bool is_shared = of_samples.size() == 1;
  return {is_shared, [of_samples = std::move(of_samples)](int64_t s) -> std::unique_ptr<Kernel<T>> {
            const auto& p = of_samples[of_samples.size() == 1 ? 0 : s];
            if (!std::isfinite(p.centre)) return nullptr;
            switch (p.dim) {
              case 1: return std::make_unique<Laplacian<T, 1>>(p);
              case 2: return std::make_unique<Laplacian<T, 2>>(p);
              default: return std::make_unique<Laplacian<T, 3>>(p);
            }
          }};
}

}  // namespace prdp::kernels
