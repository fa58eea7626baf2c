#include "prdp/operators/stokes_solve.h"

#include <numbers>

namespace prdp {

namespace {

/// Symbol of the backward difference along an axis of n points: (1 - exp(-2πi k/n))/dx.
at::Tensor backward_symbol(const at::Tensor& frequency, double n, double length) {
  const auto angle = frequency * (2.0 * std::numbers::pi / n);
  const double inverse_dx = n / length;
  return at::complex(inverse_dx - inverse_dx * angle.cos(), inverse_dx * angle.sin());
}

}  // namespace

StokesSolve::StokesSolve(const Grid& grid, const at::Tensor& nu, double dt, at::ScalarType dtype) {
  const int64_t ny = grid.shape()[0], nx = grid.shape()[1];
  const auto real = nu.options().dtype(at::kDouble);
  const auto along_x = backward_symbol(at::arange(nx / 2 + 1, real), static_cast<double>(nx), grid.length(1));
  const auto along_y = backward_symbol(at::arange(ny, real), static_cast<double>(ny), grid.length(0)).unsqueeze(-1);
  const auto symbol = at::stack({along_x.expand({ny, -1}), along_y.expand({-1, nx / 2 + 1})});
  const auto laplacian = symbol.abs().square().sum(0);
  const auto mean = laplacian.eq(0);

  const auto complex = at::toComplexType(dtype);
  gradient_ = symbol.to(complex);
  divergence_ = symbol.conj().neg().to(complex);
  momentum_ = (1.0 / dt + nu.to(at::kDouble) * laplacian).to(dtype);
  inverse_laplacian_ =
      at::where(mean, at::zeros_like(laplacian), 1.0 / at::where(mean, at::ones_like(laplacian), laplacian)).to(dtype);
}

at::Tensor StokesSolve::operator()(const at::Tensor& v, bool transposed) const {
  // C u + s G p = f, s D u = g; so p = (C g - s D f)/|G|², s being -1 in the transpose.
  const double s = transposed ? -1.0 : 1.0;
  const auto spectrum = at::fft_rfft2(v);
  const auto f = spectrum.narrow(1, 0, 2), g = spectrum.narrow(1, 2, 1);
  const auto p = (momentum_ * g - s * (divergence_ * f).sum(1, /*keepdim=*/true)) * inverse_laplacian_;
  const auto u = (f - s * gradient_ * p) / momentum_;
  return at::fft_irfft2_symint(at::cat({u, p}, 1), v.sym_sizes().slice(2, 2));
}

}  // namespace prdp
