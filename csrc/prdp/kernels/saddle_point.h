#pragma once
#include <memory>

#include "prdp/kernels/assembly.h"
#include "prdp/kernels/multigrid.h"
#include "prdp/kernels/navier_stokes.h"
#include "prdp/kernels/stencil.h"

namespace prdp::kernels {

/// M for the linearised Navier-Stokes equations [[C, G], [D, 0]]: the block triangular matrix [[Ĉ, G], [0, Ŝ]]. Ĉ⁻¹ is
/// a number of Jacobi sweeps; they converge, as the rows of C sum to 1/dt and its other entries are negative. Ŝ⁻¹
/// approximates the inverse of the Schur complement -D C⁻¹ G as if there were no winds: (1/dt) (-L)⁻¹ + ν, with a
/// V-cycle for the Laplacian of the pressure (Cahouet and Chabard 1988).
template <class T>
class SaddlePointPreconditioner final : public Preconditioner<T> {
 public:
  /// `transpose`, the kernel of Aᵀ, is needed for apply_transpose().
  SaddlePointPreconditioner(const NavierStokes<T>& a, const NavierStokes<T>* transpose, int64_t smoothing)
      : a_(a),
        transpose_(transpose),
        sweeps_(kSweepsPerSmoothing * smoothing),
        spacing_(a.parameters()),
        laplacian_(laplacian_of(a.parameters(), spacing_)) {
    cycle_ = Multigrid<T>::make(*laplacian_, nullptr, smoothing);
    memory_.prepare(kVectors, a.length(), a.layout().halo);
  }

  T apply(const T* r, T* z) override {
    solve_schur(r + pressure(), z + pressure());
    T *p = memory_.vector(kInput), *c = memory_.vector(kOutput);
    vectors_.copy(z + pressure(), p + pressure(), plane());
    a_.apply(p, c);
    vectors_.scale(T(-1), c, c, pressure());
    vectors_.axpy(T(1), r, c, pressure());
    solve_velocity(a_, c, z);
    vectors_.fill_zero(p + pressure(), plane());
    return vectors_.dot(r, z, a_.length());
  }
  void apply_transpose(const T* r, T* z) override {
    T *u = memory_.vector(kInput), *c = memory_.vector(kOutput);
    vectors_.copy(r, c, pressure());
    solve_velocity(*transpose_, c, u);
    vectors_.copy(u, z, pressure());
    transpose_->apply(u, c);
    vectors_.scale(T(-1), c + pressure(), c + pressure(), plane());
    vectors_.axpy(T(1), r + pressure(), c + pressure(), plane());
    solve_schur(c + pressure(), z + pressure());
    vectors_.fill_zero(u, pressure());
  }

 private:
  enum Vector { kInput, kOutput, kScaled, kX, kY, kVectors };
  static constexpr int64_t kSweepsPerSmoothing = 2;

  /// 1/dy² and 1/dx², 0 for an axis of one cell, and the larger of them.
  struct Spacing {
    explicit Spacing(const UpwindParameters<T>& p)
        : y(p.ny > 1 ? std::pow(static_cast<double>(p.ny) / p.length_y, 2) : 0.0),
          x(p.nx > 1 ? std::pow(static_cast<double>(p.nx) / p.length_x, 2) : 0.0),
          largest(std::max(x, y)) {}
    double y, x, largest;
  };

  /// -L on the pressure, times the square of the smaller spacing.
  static std::unique_ptr<Stencil<T>> laplacian_of(const UpwindParameters<T>& p, const Spacing& of) {
    const T y = static_cast<T>(-of.y / of.largest), x = static_cast<T>(-of.x / of.largest);
    const T along[] = {static_cast<T>(2 * (of.x + of.y) / of.largest), x, x, y, y};
    auto rows = std::make_shared<PackedStencil<T>>(p.pattern);
    for (int64_t j = 0; j < p.ny; ++j)
      for (int64_t k = 0; k < 5; ++k) std::fill_n(rows->coefficient(j, k), p.nx, along[k]);
    rows->close();
    const auto key = [p] { return FactorKeyMaker().add(p.ny).add(p.nx).add(p.length_y).add(p.length_x).key(); };
    const auto as_fields = [rows]() -> std::optional<StencilFields<T>> { return fields_of(*rows); };
    return std::make_unique<Stencil<T>>(rows, 1, T(1), typename Stencil<T>::Source{key, as_fields, false});
  }

  int64_t plane() const { return a_.layout().plane; }
  int64_t pressure() const { return 2 * plane(); }

  /// p = Ŝ⁻¹ r
  void solve_schur(const T* r, T* p) {
    const auto& of = a_.parameters();
    const double factor = static_cast<double>(a_.factor());
    if (cycle_) cycle_->apply(r, p);
    else vectors_.fill_zero(p, plane());
    vectors_.scale(static_cast<T>(1.0 / (of.dt * spacing_.largest * factor)), p, p, plane());
    vectors_.axpy(static_cast<T>(of.nu / factor), r, p, plane());
  }
  /// u = Ĉ⁻¹ r
  void solve_velocity(const NavierStokes<T>& a, const T* r, T* u) {
    for (int64_t channel = 0; channel < 2; ++channel) {
      const Stencil<T> c(a.velocity(channel), 1, T(1));
      const int64_t at = channel * plane();
      T *scaled = memory_.vector(kScaled) + at, *x = memory_.vector(kX) + at, *y = memory_.vector(kY) + at;
      c.divide_by_diagonal(r + at, scaled);
      vectors_.copy(scaled, x, plane());
      c.jacobi_sweeps(scaled, x, y, sweeps_ - 1, nullptr);
      vectors_.copy(x, u + at, plane());
    }
  }

  const NavierStokes<T>& a_;
  const NavierStokes<T>* transpose_;
  int64_t sweeps_;
  Spacing spacing_;
  std::unique_ptr<Stencil<T>> laplacian_;
  std::unique_ptr<Multigrid<T>> cycle_;
  Workspace<T> memory_;
  WholeVectors<T> vectors_;
};

}  // namespace prdp::kernels
