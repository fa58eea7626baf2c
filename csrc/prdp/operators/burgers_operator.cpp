#include "prdp/operators/burgers_operator.h"

#include "prdp/kernels/burgers.h"
#include "prdp/operators/dense.h"
#include "prdp/operators/stencil_operator.h"
#include "prdp/operators/upwind_kernels.h"
#include "prdp/operators/upwind_rule_loops.h"

namespace prdp {

BurgersOperator::BurgersOperator(const OperatorSpec& spec)
    : UpwindOperator("Burgers", spec, static_cast<int64_t>(spec.shape.size())) {
  TORCH_CHECK_VALUE(grid_.dim() <= 2, "Burgers: shape must have 1 or 2 extents, got ", at::IntArrayRef(grid_.shape()));
  grid_.check_field(winds_, channels_);
}

const AdvectionDiffusion& BurgersOperator::block() const {
  if (!made_) {
    std::vector<AxisWinds> faces;
    for (int64_t d = 0; d < grid_.dim(); ++d)
      faces.push_back({backward_mean(wind_along(d), grid_, d), forward_mean(wind_along(d), grid_, d)});
    made_.emplace(grid_, std::move(faces), step_.nu_beside(grid_.dim()), 1.0, step_.dt);
  }
  return *made_;
}

std::vector<at::Tensor> BurgersOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  auto found = burgers_rule_by_kernel(grid_, winds_, step_.dt, lambda, u);
  if (!found) found = burgers_rule_on_loops(grid_, winds_, step_.dt, lambda, u);
  if (found) return gradients(*found);
  const auto [faces, nu_terms] = block().product_rule(lambda, u);
  std::vector<at::Tensor> channels;
  for (int64_t d = grid_.dim() - 1; d >= 0; --d)  // the means, transposed
    channels.push_back(forward_mean(faces[d].lower, grid_, d) + backward_mean(faces[d].upper, grid_, d));
  return gradients({as_winds(std::move(channels)), {nu_terms}});
}

at::Tensor BurgersOperator::solve_directly(const at::Tensor& b, bool transposed) const {
  if (!b.is_cpu()) return StencilOperator(as_stencil(b)).solve_directly(b, transposed);
  const auto matrix = channel_matrix(*this, winds_.options());
  return solve_channels(transposed ? matrix.mT() : matrix, b);
}

OperatorSpec BurgersOperator::as_stencil(const at::Tensor& b) const {
  const std::vector<bool> periodic(grid_.dim(), true);
  return nearest_stencil(block().coefficients().to(b.scalar_type()), grid_.shape(), periodic);
}

std::shared_ptr<const kernels::Kernels> BurgersOperator::kernels(const at::Tensor& b, bool transposed) const {
  return upwind_kernels(b, transposed, [dim = grid_.dim()](const auto& p) { return kernels::burgers(p, dim); });
}

std::optional<gpu::OperatorView> BurgersOperator::gpu_view(const at::Tensor& b, bool transposed) const {
  return upwind_view(b, "Burgers", std::to_string(channels_) + ", " + std::to_string(transposed), 1.0, step_.dt);
}

std::unique_ptr<Operator> BurgersOperator::select(const at::Tensor& index) const {
  auto chosen = std::make_unique<BurgersOperator>(*this);
  chosen->take_samples(index);
  chosen->made_.reset();
  return chosen;
}

}  // namespace prdp
