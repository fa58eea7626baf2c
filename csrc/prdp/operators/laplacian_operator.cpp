#include "prdp/operators/laplacian_operator.h"

#include <cmath>

namespace prdp {

namespace {

/// The diagonal of L: -Σ_d 2 / dx_d².
double laplacian_centre(const Grid& grid) {
  double centre = 0.0;
  for (int64_t d = 0; d < grid.dim(); ++d) centre -= 2.0 / (grid.dx(d) * grid.dx(d));
  return centre;
}

}  // namespace

at::Tensor LaplacianOperator::diagonal() const {
  return symbol(at::scalar_tensor(laplacian_centre(grid_), at::kDouble));
}

at::Tensor LaplacianOperator::solve_directly(const at::Tensor& b) const {
  const auto eigenvalues = symbol(laplacian_eigenvalues(grid_, b.options()));
  return sine_transform(sine_transform(b, grid_) / eigenvalues.to(b.scalar_type()), grid_);
}

at::Tensor LaplacianOperator::norm() const {
  const auto [alpha, beta] = coefficients();
  const double centre = laplacian_centre(grid_);
  return at::scalar_tensor(std::abs(alpha + beta * centre) + std::abs(beta * centre), at::kDouble);
}

std::vector<int64_t> LaplacianOperator::vector_shape() const {
  std::vector<int64_t> shape{1};
  shape.insert(shape.end(), grid_.shape().begin(), grid_.shape().end());
  return shape;
}

KernelParameters LaplacianOperator::kernel() const {
  const auto [alpha, beta] = coefficients();
  kernels::LaplacianParameters k;
  k.dim = grid_.dim();
  k.centre = alpha + beta * laplacian_centre(grid_);
  for (int64_t d = 0; d < k.dim; ++d) {
    k.shape[d] = grid_.shape()[d];
    k.off[d] = beta / (grid_.dx(d) * grid_.dx(d));
  }
  return k;
}

PoissonOperator::PoissonOperator(const OperatorSpec& spec)
    : LaplacianOperator(Grid("Poisson", spec.shape)) {
  TORCH_CHECK_VALUE(spec.parameters.empty() && spec.tensors.empty(),
                    "Poisson: takes no parameters and no tensors");
}

HeatOperator::HeatOperator(const OperatorSpec& spec)
    : LaplacianOperator(Grid("Heat", spec.shape)) {
  TORCH_CHECK_VALUE(spec.parameters.size() == 1 && spec.tensors.size() == 1,
                    "Heat: takes one parameter, dt, and one tensor, nu");
  dt_ = spec.parameters[0];
  nu_ = spec.tensors[0];
  TORCH_CHECK_VALUE(std::isfinite(dt_) && dt_ > 0.0, "Heat: dt must be finite and > 0, got ", dt_);
  TORCH_CHECK_VALUE(nu_.dim() == 0, "Heat: nu must be a number or a 0-dimensional tensor, got shape ",
                    nu_.sizes());
  TORCH_CHECK_TYPE(at::isFloatingType(nu_.scalar_type()), "Heat: nu must be a real number, got ",
                   nu_.scalar_type());
}

void HeatOperator::check_parameters() const {
  const double nu = nu_.item<double>();
  TORCH_CHECK_VALUE(std::isfinite(nu) && nu >= 0.0, "Heat: nu must be finite and >= 0, got ", nu);
}

at::Tensor HeatOperator::apply(const at::Tensor& v) const {
  return v - (nu_ * dt_) * laplacian(v, grid_);
}

std::vector<at::Tensor> HeatOperator::product_rule(const at::Tensor& lambda,
                                                   const at::Tensor& u) const {
  // ∂⟨λ, u - ν Δt L u⟩/∂ν = -Δt ⟨λ, L u⟩
  const auto derivative = (lambda * laplacian(u, grid_)).sum() * -dt_;
  return {derivative.to(nu_.options())};
}

}  // namespace prdp
