#include "prdp/operators/advection_diffusion.h"

namespace prdp {

namespace {

// By |w| and not by clamp: NaN stays NaN, and the derivative at w = 0 is 1/2, torch's sign(0) being 0.
at::Tensor positive_part(const at::Tensor& w) { return 0.5 * (w + w.abs()); }
at::Tensor negative_part(const at::Tensor& w) { return 0.5 * (w - w.abs()); }
at::Tensor positive_part_slope(const at::Tensor& w) { return 0.5 * (1.0 + w.sign()); }
at::Tensor negative_part_slope(const at::Tensor& w) { return 0.5 * (1.0 - w.sign()); }

}  // namespace

AdvectionDiffusion::AdvectionDiffusion(const Grid& grid, std::vector<AxisWinds> winds, at::Tensor nu, double alpha,
                                       double beta)
    : grid_(grid), winds_(std::move(winds)), nu_(std::move(nu)), alpha_(alpha), beta_(beta) {
  for (const auto& w : winds_) inflow_.push_back({positive_part(w.lower), negative_part(w.upper)});
}

at::Tensor AdvectionDiffusion::apply(const at::Tensor& v) const {
  auto sum = -nu_ * laplacian(v, grid_);
  for (int64_t d = 0; d < grid_.dim(); ++d)
    sum =
        sum + inflow_[d].lower * backward_difference(v, grid_, d) + inflow_[d].upper * forward_difference(v, grid_, d);
  return alpha_ * v + beta_ * sum;
}

at::Tensor AdvectionDiffusion::apply_transpose(const at::Tensor& v) const {
  // Bᵀ = -F, Fᵀ = -B
  auto sum = -nu_ * laplacian(v, grid_);
  for (int64_t d = 0; d < grid_.dim(); ++d)
    sum =
        sum - forward_difference(inflow_[d].lower * v, grid_, d) - backward_difference(inflow_[d].upper * v, grid_, d);
  return alpha_ * v + beta_ * sum;
}

at::Tensor AdvectionDiffusion::diagonal() const {
  auto sum = -nu_ * laplacian_diagonal(grid_);
  for (int64_t d = 0; d < grid_.dim(); ++d) sum = sum + (inflow_[d].lower - inflow_[d].upper) * (1.0 / grid_.dx(d));
  return alpha_ + beta_ * sum;
}

at::Tensor AdvectionDiffusion::column_norms() const {
  const auto d = diagonal();
  return 2.0 * d - apply_transpose(at::ones_like(d));
}

at::Tensor AdvectionDiffusion::coefficients() const {
  std::vector<at::Tensor> all{diagonal()};
  for (int64_t d = 0; d < grid_.dim(); ++d) {
    const double per_dx = 1.0 / grid_.dx(d);
    const auto diffusion = nu_ * (per_dx * per_dx);
    all.push_back(beta_ * (-inflow_[d].lower * per_dx - diffusion));
    all.push_back(beta_ * (inflow_[d].upper * per_dx - diffusion));
  }
  return at::cat(all, 1);
}

AdvectionDiffusion::Gradients AdvectionDiffusion::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  const auto weight = beta_ * lambda;
  Gradients gradients{{}, -weight * laplacian(u, grid_)};
  const auto over_channels = [](const at::Tensor& t) { return t.sum(1, /*keepdim=*/true); };
  for (int64_t d = 0; d < grid_.dim(); ++d)
    gradients.winds.push_back(
        {positive_part_slope(winds_[d].lower) * over_channels(weight * backward_difference(u, grid_, d)),
         negative_part_slope(winds_[d].upper) * over_channels(weight * forward_difference(u, grid_, d))});
  return gradients;
}

}  // namespace prdp
