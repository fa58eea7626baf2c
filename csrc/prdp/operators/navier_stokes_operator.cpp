#include "prdp/operators/navier_stokes_operator.h"

#include "prdp/gpu/part_of.h"
#include "prdp/kernels/navier_stokes.h"
#include "prdp/operators/dense.h"
#include "prdp/operators/sums_in_order.h"
#include "prdp/operators/upwind_kernels.h"
#include "prdp/operators/upwind_rule_loops.h"

namespace prdp {

namespace {

constexpr int64_t kY = 0, kX = 1;  // the grid's axes

/// One of (u₁, u₂, p), the channel axis kept. Counted from the end: there may be a further axis in front.
at::Tensor part(const at::Tensor& v, int64_t channel) { return v.narrow(-3, channel, 1); }

/// Means of four neighbours: of u₂ at the points of u₁, and of u₁ at the points of u₂. Each is the
/// transpose of the other.
at::Tensor at_u1_points(const at::Tensor& u2, const Grid& grid) {
  return forward_mean(backward_mean(u2, grid, kX), grid, kY);
}
at::Tensor at_u2_points(const at::Tensor& u1, const Grid& grid) {
  return backward_mean(forward_mean(u1, grid, kX), grid, kY);
}

}  // namespace

at::Tensor without_mean_pressure(const at::Tensor& u) {
  if (u.size(-3) == 2) return u;
  const auto p = part(u, 2);
  return at::cat({u.narrow(-3, 0, 2), p - mean_in_order(p, {-2, -1})}, -3);
}

NavierStokesOperator::NavierStokesOperator(const OperatorSpec& spec) : UpwindOperator("NavierStokes", spec, 3) {
  TORCH_CHECK_VALUE(grid_.dim() == 2, "NavierStokes: shape must have 2 extents, got ", at::IntArrayRef(grid_.shape()));
  grid_.check_field(winds_, winds_.dim() == 4 && winds_.sym_size(1) == 2 ? 2 : 3);
}

const NavierStokesOperator::Momentum& NavierStokesOperator::momentum() const {
  if (!made_) {
    const auto u1 = wind_along(kX), u2 = wind_along(kY);
    const auto v1 = at_u2_points(u1, grid_), v2 = at_u1_points(u2, grid_);
    const auto c = [&](const at::Tensor& along_y, const at::Tensor& along_x) {
      return AdvectionDiffusion(grid_, {{along_y, along_y}, {along_x, along_x}}, step_.nu_beside(2), 1.0 / step_.dt,
                                1.0);
    };
    made_.emplace(Momentum{c(v2, u1), c(u2, v1)});
  }
  return *made_;
}

at::Tensor NavierStokesOperator::couple(const at::Tensor& c1_u1, const at::Tensor& c2_u2, double s,
                                        const at::Tensor& v) const {
  const auto u1 = part(v, 0), u2 = part(v, 1), p = part(v, 2);
  const auto divergence = forward_difference(u1, grid_, kX) + forward_difference(u2, grid_, kY);
  return at::cat(
      {c1_u1 + s * backward_difference(p, grid_, kX), c2_u2 + s * backward_difference(p, grid_, kY), s * divergence},
      -3);
}

at::Tensor NavierStokesOperator::apply(const at::Tensor& v) const {
  const auto& [c1, c2] = momentum();
  return couple(c1.apply(part(v, 0)), c2.apply(part(v, 1)), 1.0, v);
}

at::Tensor NavierStokesOperator::apply_transpose(const at::Tensor& v) const {
  const auto& [c1, c2] = momentum();
  return couple(c1.apply_transpose(part(v, 0)), c2.apply_transpose(part(v, 1)), -1.0, v);  // G = -Dᵀ
}

at::Tensor NavierStokesOperator::diagonal() const {
  const auto& [c1, c2] = momentum();
  const auto d1 = c1.diagonal();
  return at::cat({d1, c2.diagonal(), at::zeros_like(d1)}, 1);
}

at::Tensor NavierStokesOperator::norm() const {
  const auto& [c1, c2] = momentum();
  return norm_of(c1.row_norms(), c2.row_norms());
}

at::Tensor NavierStokesOperator::norm_of_transpose() const {
  const auto& [c1, c2] = momentum();
  return norm_of(c1.column_norms(), c2.column_norms());  // G = -Dᵀ
}

at::Tensor NavierStokesOperator::norm_of(const at::Tensor& of_c1, const at::Tensor& of_c2) const {
  const double x = 2.0 / grid_.dx(kX), y = 2.0 / grid_.dx(kY);  // the rows of G₁ and G₂
  const auto n1 = of_c1 + x;
  return largest(at::cat({n1, of_c2 + y, at::full_like(n1, x + y)}, 1));
}

std::vector<at::Tensor> NavierStokesOperator::product_rule(const at::Tensor& lambda, const at::Tensor& u) const {
  auto found = navier_stokes_rule_by_kernel(grid_, winds_, lambda, u);
  if (!found) found = navier_stokes_rule_on_loops(grid_, winds_, lambda, u);
  if (found) return gradients(*found);
  const auto& [c1, c2] = momentum();
  const auto g1 = c1.product_rule(part(lambda, 0), part(u, 0));
  const auto g2 = c2.product_rule(part(lambda, 1), part(u, 1));
  const auto both = [](const AxisWinds& w) { return w.lower + w.upper; };
  const auto u1 = both(g1.winds[kX]) + at_u1_points(both(g2.winds[kX]), grid_);
  const auto u2 = both(g2.winds[kY]) + at_u2_points(both(g1.winds[kY]), grid_);
  return gradients({as_winds({u1, u2}), {g1.nu_terms, g2.nu_terms}});
}

at::Tensor NavierStokesOperator::regular_matrix() const {
  const int64_t cells = grid_.unknowns(), n = 3 * cells;
  check_dense_fits(winds_, n, winds_.size(0));
  const auto units = at::eye(n, winds_.options()).view({n, 1, 3, grid_.shape()[kY], grid_.shape()[kX]});
  const auto columns = apply(units.expand({-1, winds_.size(0), -1, -1, -1}));
  const auto a = columns.flatten(2).permute({1, 2, 0});  // (unit, batch, n) → (batch, n, unit)
  const auto pressure = (at::arange(n, winds_.options()) >= 2 * cells).to(winds_.scalar_type());
  return a + at::outer(pressure, pressure) / static_cast<double>(cells);
}

at::Tensor NavierStokesOperator::solve_directly(const at::Tensor& b, bool transposed) const {
  const auto matrix = regular_matrix(), rhs = project(b).flatten(1).unsqueeze(-1);
  return project(solve_dense(transposed ? matrix.mT() : matrix, rhs).reshape_as(b));
}

std::shared_ptr<const kernels::Kernels> NavierStokesOperator::kernels(const at::Tensor& b, bool transposed) const {
  return upwind_kernels(b, transposed, [](const auto& p) { return kernels::navier_stokes(p); });
}

std::optional<gpu::OperatorView> NavierStokesOperator::gpu_view(const at::Tensor& b, bool transposed) const {
  auto view = upwind_view(b, "NavierStokes", std::to_string(transposed), 1.0 / step_.dt, 1.0);
  view.null_space = view.left_null_space = gpu::part_of(b, 0, 0, b.scalar_type());
  view.null_field = 2;  // the pressure
  return view;
}

std::unique_ptr<Operator> NavierStokesOperator::select(const at::Tensor& index) const {
  auto chosen = std::make_unique<NavierStokesOperator>(*this);
  chosen->take_samples(index);
  chosen->made_.reset();
  return chosen;
}

}  // namespace prdp
